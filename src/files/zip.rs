//! ZIP files without compression, made piece by piece: nothing but the names of the entries is held in memory.

use std::io;

/// Most entries of a file.
const MAX_ENTRIES: usize = 1 << 20;
/// Largest number that a plain field of 32 bits holds; larger ones stand in fields of 64 bits.
const FULL: u64 = u32::MAX as u64;
/// Bytes of an entry's header before its name, and of its record in the directory.
const HEADER: u64 = 30;
const RECORD: u64 = 46;
/// Bytes that a record has more where the entry begins beyond [`FULL`].
const FAR: u64 = 12;
/// Names are UTF-8.
const FLAGS: u16 = 1 << 11;
/// The first day that the format knows: entries have no times, so that equal contents are equal files.
const DAY: u16 = 0x21;

/// Entries of a ZIP file, in their order.
#[derive(Debug, Default)]
pub(crate) struct Zip {
    names: String,
    entries: Vec<Entry>,
}

#[derive(Debug)]
struct Entry {
    /// End of its name in the names.
    end: u32,
    size: u32,
    checksum: u32,
}

impl Zip {
    /// Adds an entry of `size` bytes and gives its number.
    ///
    /// # Errors
    /// Too many entries, or one of 4 GiB or more.
    pub(crate) fn add(&mut self, name: &str, size: u64) -> io::Result<usize> {
        let refuse = |_| io::Error::other(format!("{name}: {size} bytes, allowed: less than 4 GiB"));
        let size = u32::try_from(size).map_err(refuse)?;
        if self.entries.len() >= MAX_ENTRIES {
            return Err(io::Error::other(format!("more than {MAX_ENTRIES} files: copy the folder instead")));
        }
        self.names.push_str(name);
        let end = u32::try_from(self.names.len()).map_err(io::Error::other)?;
        self.entries.push(Entry { end, size, checksum: 0 });
        Ok(self.entries.len() - 1)
    }

    /// Number of entries.
    pub(crate) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Name of entry `index`.
    pub(crate) fn name(&self, index: usize) -> &str {
        let start = index.checked_sub(1).map_or(0, |before| self.entries[before].end as usize);
        &self.names[start..self.entries[index].end as usize]
    }

    /// Bytes of entry `index`.
    pub(crate) fn size(&self, index: usize) -> u64 {
        u64::from(self.entries[index].size)
    }

    /// Bytes of the whole file.
    pub(crate) fn total_bytes(&self) -> u64 {
        let (start, size) = self.directory_range();
        start + size + if self.is_large(start, size) { 56 + 20 + 22 } else { 22 }
    }

    /// Notes the CRC-32 of entry `index`; gives the header that stands before its bytes.
    pub(crate) fn header(&mut self, index: usize, checksum: u32) -> Vec<u8> {
        self.entries[index].checksum = checksum;
        let mut out = Vec::with_capacity(64);
        out.extend(b"PK\x03\x04");
        self.common(index, 20, &mut out);
        out.extend(0u16.to_le_bytes());
        out.extend(self.name(index).as_bytes());
        out
    }

    /// Appends the records of the directory from entry `first` on, which begins at byte `offset` of the file, until `out` has `most` bytes.
    /// Gives the entry and its offset to go on with.
    pub(crate) fn directory(&self, first: usize, mut offset: u64, most: usize, out: &mut Vec<u8>) -> (usize, u64) {
        let mut index = first;
        while index < self.len() && out.len() < most {
            let far = offset >= FULL;
            let version: u16 = if far { 45 } else { 20 };
            out.extend(b"PK\x01\x02");
            out.extend((3 << 8 | version).to_le_bytes());
            self.common(index, version, out);
            out.extend(if far { FAR as u16 } else { 0 }.to_le_bytes());
            // no comment, first disk, a binary file
            out.extend([0; 6]);
            // a plain file that its owner may change
            out.extend((0o100_644u32 << 16).to_le_bytes());
            out.extend((offset.min(FULL) as u32).to_le_bytes());
            out.extend(self.name(index).as_bytes());
            if far {
                out.extend(1u16.to_le_bytes());
                out.extend(8u16.to_le_bytes());
                out.extend(offset.to_le_bytes());
            }
            offset += HEADER + self.name(index).len() as u64 + self.size(index);
            index += 1;
        }
        (index, offset)
    }

    /// End of the file, after the directory.
    pub(crate) fn end(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(98);
        let (start, size) = self.directory_range();
        let count = self.len() as u64;
        if self.is_large(start, size) {
            out.extend(b"PK\x06\x06");
            out.extend(44u64.to_le_bytes());
            out.extend((3u16 << 8 | 45).to_le_bytes());
            out.extend(45u16.to_le_bytes());
            out.extend([0; 8]);
            for number in [count, count, size, start] {
                out.extend(number.to_le_bytes());
            }
            out.extend(b"PK\x06\x07");
            out.extend([0; 4]);
            out.extend((start + size).to_le_bytes());
            out.extend(1u32.to_le_bytes());
        }
        out.extend(b"PK\x05\x06");
        out.extend([0; 4]);
        for _ in 0..2 {
            out.extend((count.min(u64::from(u16::MAX)) as u16).to_le_bytes());
        }
        for number in [size, start] {
            out.extend((number.min(FULL) as u32).to_le_bytes());
        }
        out.extend([0; 2]);
        out
    }

    /// Fields that an entry's header and its record in the directory share, up to the length of its name.
    fn common(&self, index: usize, version: u16, out: &mut Vec<u8>) {
        let Entry { size, checksum, .. } = self.entries[index];
        for number in [version, FLAGS, 0, 0, DAY] {
            out.extend(number.to_le_bytes());
        }
        for number in [checksum, size, size] {
            out.extend(number.to_le_bytes());
        }
        out.extend((self.name(index).len() as u16).to_le_bytes());
    }

    /// First byte and length of the directory.
    fn directory_range(&self) -> (u64, u64) {
        let (mut start, mut size) = (0, 0);
        for index in 0..self.len() {
            let name = self.name(index).len() as u64;
            size += RECORD + name + if start >= FULL { FAR } else { 0 };
            start += HEADER + name + self.size(index);
        }
        (start, size)
    }

    fn is_large(&self, start: u64, size: u64) -> bool {
        self.len() >= usize::from(u16::MAX) || start >= FULL || size >= FULL
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_is_known_before_the_first_byte() {
        let mut zip = Zip::default();
        let contents = ["", "one", "two and three"];
        for (n, content) in contents.iter().enumerate() {
            zip.add(&format!("folder/{n}"), content.len() as u64).unwrap();
        }
        let mut file = Vec::new();
        let total = zip.total_bytes();
        for (n, content) in contents.iter().enumerate() {
            file.extend(zip.header(n, crc32fast::hash(content.as_bytes())));
            file.extend(content.as_bytes());
        }
        let mut at = (0, 0);
        while at.0 < zip.len() {
            let mut records = Vec::new();
            at = zip.directory(at.0, at.1, 1, &mut records);
            file.extend(records);
        }
        file.extend(zip.end());
        assert_eq!(file.len() as u64, total);
        assert!(zip.add("large", 1 << 32).is_err());
    }

    #[test]
    fn beyond_four_gigabytes_numbers_have_64_bits() {
        let mut zip = Zip::default();
        for n in 0..3 {
            zip.add(&n.to_string(), u64::from(u32::MAX) - 9).unwrap();
        }
        let mut directory = Vec::new();
        zip.directory(0, 0, usize::MAX, &mut directory);
        let (start, size) = zip.directory_range();
        assert_eq!((start, size), (3 * (31 + FULL - 9), directory.len() as u64));
        assert_eq!(zip.total_bytes(), start + size + zip.end().len() as u64);
        assert_eq!(zip.end().len(), 98);
    }
}
