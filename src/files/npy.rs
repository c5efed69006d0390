//! Reader and writer of NPY files (`numpy.lib.format`, versions 1 to 3).
//!
//! The reader is our own because existing parsers allocate by the header's numbers unchecked and recurse without bound.

use std::fmt::Write as _;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use super::{Array, ArrayError, Values, WriteError, open, unsupported, write_atomic};

pub(super) const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header that is read, in bytes; NumPy's headers of plain arrays take 118.
const MAX_HEADER: usize = 4096;
const DTYPES: &str = "|u1, <u2, >u2, <f4, >f4, <f8, >f8";
const GRAMMAR: &str = "a dict of 'descr', 'fortran_order' and 'shape' as NumPy writes it";

/// Reads an NPY file of 8 or 16 bit counts or floating point, in any byte and axis order.
///
/// # Errors
/// [`ArrayError`]: the file is missing, not NPY, of another data type, empty, or its length does not match its header.
pub fn read_npy(path: &Path) -> Result<Array, ArrayError> {
    let (file, length) = open(path)?;
    decode(path, BufReader::new(file), length)
}

/// Reads an NPY file of `length` bytes from `reader`; `path` is for messages.
pub(super) fn decode(path: &Path, mut reader: impl Read, length: u64) -> Result<Array, ArrayError> {
    let header = read_header(path, &mut reader)?;
    let kind = check(path, &header, length)?;
    let Header { fortran, shape, .. } = header;
    let samples = read_samples(&mut reader, &kind, shape.iter().product())
        .map_err(|source| ArrayError::Io { path: path.to_path_buf(), source })?;
    let samples = match samples {
        samples if !fortran => samples,
        Values::U8(v) => Values::U8(c_order(&shape, &v)),
        Values::U16(v) => Values::U16(c_order(&shape, &v)),
        Values::F32(v) => Values::F32(c_order(&shape, &v)),
    };
    Ok(Array { shape, samples })
}

/// The number format of an array, whose size is checked against the `length` of its file.
pub(super) fn check(path: &Path, header: &Header, length: u64) -> Result<Kind, ArrayError> {
    let Header { dtype, shape, bytes, .. } = header;
    if shape.contains(&0) {
        return Err(unsupported(path, "shape", format!("{shape:?}"), "no axis of length 0"));
    }
    let Some(kind) = Kind::of(dtype) else {
        return Err(unsupported(path, "data type", dtype, DTYPES));
    };
    // a saturated product matches no file, because no file is that long
    let expected = shape.iter().fold(kind.width() as u128, |n, &axis| n.saturating_mul(axis as u128));
    let found = length.saturating_sub(*bytes as u64);
    if expected != u128::from(found) {
        let (path, shape, dtype) = (path.to_path_buf(), shape.clone(), dtype.clone());
        return Err(ArrayError::Length { path, shape, dtype, expected, found });
    }
    Ok(kind)
}

/// Reads `count` values.
pub(super) fn read_samples(reader: &mut impl Read, kind: &Kind, count: usize) -> io::Result<Values> {
    Ok(match *kind {
        Kind::U8 => Values::U8(read_values(reader, count, |[b]: [u8; 1]| b)?),
        Kind::U16(order) => Values::U16(read_values(reader, count, |b| u16::from_le_bytes(order.little(b)))?),
        Kind::F32(order) => Values::F32(read_values(reader, count, |b| f32::from_le_bytes(order.little(b)))?),
        Kind::F64(order) => Values::F32(read_values(reader, count, |b| f64::from_le_bytes(order.little(b)) as f32)?),
    })
}

#[derive(Clone, Copy)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

impl ByteOrder {
    fn little<const N: usize>(self, mut bytes: [u8; N]) -> [u8; N] {
        if matches!(self, Self::Big) {
            bytes.reverse();
        }
        bytes
    }
}

pub(super) enum Kind {
    U8,
    U16(ByteOrder),
    F32(ByteOrder),
    F64(ByteOrder),
}

impl Kind {
    fn of(dtype: &str) -> Option<Self> {
        use ByteOrder::{Big, Little};
        Some(match dtype {
            "|u1" | "<u1" | ">u1" => Self::U8,
            "<u2" => Self::U16(Little),
            ">u2" => Self::U16(Big),
            "<f4" => Self::F32(Little),
            ">f4" => Self::F32(Big),
            "<f8" => Self::F64(Little),
            ">f8" => Self::F64(Big),
            _ => return None,
        })
    }

    pub(super) fn width(&self) -> usize {
        match self {
            Self::U8 => 1,
            Self::U16(_) => 2,
            Self::F32(_) => 4,
            Self::F64(_) => 8,
        }
    }
}

/// Reads `count` values of `N` bytes in blocks, so that only the result takes memory.
fn read_values<T, const N: usize>(
    reader: &mut impl Read,
    count: usize,
    of: impl Fn([u8; N]) -> T,
) -> io::Result<Vec<T>> {
    let mut values = Vec::with_capacity(count);
    let mut block = [0; 8192];
    while values.len() < count {
        let bytes = &mut block[..8192.min((count - values.len()) * N)];
        reader.read_exact(bytes)?;
        values.extend(bytes.as_chunks::<N>().0.iter().map(|&b| of(b)));
    }
    Ok(values)
}

/// Converts values from Fortran order (first axis fastest) to C order.
fn c_order<T: Copy>(shape: &[usize], values: &[T]) -> Vec<T> {
    let mut index = vec![0; shape.len()];
    let mut out = Vec::with_capacity(values.len());
    for _ in 0..values.len() {
        let at = index.iter().zip(shape).rev().fold(0, |at, (&i, &n)| at * n + i);
        out.push(values[at]);
        for (i, &n) in index.iter_mut().zip(shape).rev() {
            *i += 1;
            if *i < n {
                break;
            }
            *i = 0;
        }
    }
    out
}

pub(super) struct Header {
    dtype: String,
    pub(super) fortran: bool,
    pub(super) shape: Vec<usize>,
    /// Length of the header in bytes.
    pub(super) bytes: usize,
}

pub(super) fn read_header(path: &Path, reader: &mut impl Read) -> Result<Header, ArrayError> {
    let mut take = |bytes: &mut [u8]| {
        reader.read_exact(bytes).map_err(|source| match source.kind() {
            io::ErrorKind::UnexpectedEof => unsupported(path, "header", "cut short", GRAMMAR),
            _ => ArrayError::Io { path: path.to_path_buf(), source },
        })
    };
    let mut preamble = [0; 8];
    take(&mut preamble)?;
    if !preamble.starts_with(MAGIC) {
        return Err(unsupported(path, "file type", format!("{:02x?}", &preamble[..6]), "NPY"));
    }
    let mut length = [0; 4];
    let width = match preamble[6] {
        1 => 2,
        2 | 3 => 4,
        v => return Err(unsupported(path, "NPY version", v.to_string(), "1, 2 or 3")),
    };
    take(&mut length[..width])?;
    let length = u32::from_le_bytes(length) as usize;
    if length > MAX_HEADER {
        return Err(unsupported(path, "header", format!("{length} bytes long"), "at most 4096 bytes"));
    }
    let mut text = vec![0; length];
    take(&mut text)?;
    let text = String::from_utf8_lossy(&text);
    let (dtype, fortran, shape) =
        parse(&text).ok_or_else(|| unsupported(path, "header", format!("{:?}", text.trim_end()), GRAMMAR))?;
    Ok(Header { dtype, fortran, shape, bytes: 8 + width + length })
}

/// Parses a header: data type, Fortran order and shape, in any order.
fn parse(text: &str) -> Option<(String, bool, Vec<usize>)> {
    let mut rest = text.trim_end().strip_prefix('{')?.strip_suffix('}')?.trim();
    let (mut dtype, mut fortran, mut shape) = (None, None, None);
    while !rest.is_empty() {
        let (key, after) = quoted(rest)?;
        let value = after.trim_start().strip_prefix(':')?.trim_start();
        let after = match key {
            "descr" => {
                let (name, after) = quoted(value)?;
                dtype = Some(name.to_owned());
                after
            }
            "fortran_order" => {
                let after = value.strip_prefix("True").or_else(|| value.strip_prefix("False"))?;
                fortran = Some(value.starts_with('T'));
                after
            }
            "shape" => {
                let (inside, after) = value.strip_prefix('(')?.split_once(')')?;
                shape = Some(axes(inside)?);
                after
            }
            _ => return None,
        };
        let after = after.trim_start();
        rest = if after.is_empty() { after } else { after.strip_prefix(',')?.trim_start() };
    }
    Some((dtype?, fortran?, shape?))
}

/// Splits a Python string without escapes from the text after it.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote)
}

fn axes(inside: &str) -> Option<Vec<usize>> {
    let inside = inside.trim();
    let inside = inside.strip_suffix(',').unwrap_or(inside);
    if inside.is_empty() {
        return Some(Vec::new());
    }
    // Python 2 wrote 128L for 128
    inside.split(',').map(|axis| axis.trim().trim_end_matches('L').parse().ok()).collect()
}

/// A number format of NPY files that are written; little-endian.
pub trait Element: Copy {
    /// NumPy's name of the format.
    const DESCR: &'static str;

    /// Writes one value.
    ///
    /// # Errors
    /// Those of `out`.
    fn write_to(self, out: &mut dyn Write) -> io::Result<()>;
}

impl Element for f32 {
    const DESCR: &'static str = "<f4";

    fn write_to(self, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.to_le_bytes())
    }
}

impl Element for u16 {
    const DESCR: &'static str = "<u2";

    fn write_to(self, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.to_le_bytes())
    }
}

/// Writes `values` atomically as an NPY file in C order, byte for byte as NumPy does.
///
/// # Errors
/// [`WriteError`]; `Shape` when the number of values does not match `shape`.
pub fn write_npy<T: Element>(path: &Path, shape: &[usize], values: &[T]) -> Result<(), WriteError> {
    if shape.iter().try_fold(1usize, |n, &axis| n.checked_mul(axis)) != Some(values.len()) {
        return Err(WriteError::Shape { path: path.to_path_buf(), shape: shape.to_vec(), found: values.len() });
    }
    write_atomic(path, |out| encode_npy(out, shape, values.iter().copied()))
}

/// Writes `values` of `shape` in the NPY format to `out`, one by one, so they need not lie in memory.
///
/// # Errors
/// Those of `out`.
pub fn encode_npy<T: Element>(
    out: &mut dyn Write,
    shape: &[usize],
    values: impl IntoIterator<Item = T>,
) -> io::Result<()> {
    out.write_all(&header(T::DESCR, shape))?;
    values.into_iter().try_for_each(|v| v.write_to(out))
}

/// Bytes of a file before its values, whose format NumPy calls `descr`.
#[cfg(feature = "program")]
pub(crate) fn npy_header(descr: &str, shape: &[usize]) -> Vec<u8> {
    header(descr, shape)
}

/// Header with magic, version 1 and the dict. As in NumPy, it leaves space for 21 digits of the first axis and ends on a multiple of
/// 64 bytes.
fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let mut axes = String::new();
    for (i, axis) in shape.iter().enumerate() {
        // writing to a String cannot fail
        let _ = write!(axes, "{}{axis}", if i == 0 { "" } else { ", " });
    }
    if shape.len() == 1 {
        axes.push(',');
    }
    let mut dict = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({axes}), }}");
    let growth = shape.first().map_or(0, |axis| 21 - axis.to_string().len());
    let used = MAGIC.len() + 4 + dict.len() + growth + 1;
    dict.extend(std::iter::repeat_n(' ', growth + 64 - used % 64));
    dict.push('\n');
    let mut out = MAGIC.to_vec();
    out.extend([1, 0]);
    out.extend((dict.len() as u16).to_le_bytes());
    out.extend(dict.as_bytes());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOLDEN: &[(&str, &[usize])] = &[("vector", &[3]), ("planes", &[2, 3, 4]), ("channels", &[3, 4, 1, 2])];

    fn golden(name: &str) -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/{name}.npy"))
    }

    /// Values of every golden file: 0.1·i − 0.5, computed in double precision.
    fn ramp(count: usize) -> Vec<f32> {
        (0..count).map(|i| (0.1 * i as f64 - 0.5) as f32).collect()
    }

    fn of_bytes(bytes: &[u8]) -> Result<Array, ArrayError> {
        decode(Path::new("a.npy"), bytes, bytes.len() as u64)
    }

    /// An NPY file with the given dict and payload.
    fn file(dict: &str, payload: &[u8]) -> Vec<u8> {
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((dict.len() as u16).to_le_bytes());
        out.extend(dict.as_bytes());
        out.extend(payload);
        out
    }

    #[test]
    fn files_are_byte_for_byte_numpys() {
        let dir = tempfile::tempdir().unwrap();
        for &(name, shape) in GOLDEN {
            let path = dir.path().join("a.npy");
            write_npy(&path, shape, &ramp(shape.iter().product())).unwrap();
            assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(golden(name)).unwrap(), "{name}");
            assert_eq!(read_npy(&path).unwrap().into_f32(), ramp(shape.iter().product()), "{name}");
        }
    }

    #[test]
    fn every_type_and_order_numpy_writes_is_read() {
        let counts: Vec<f32> = (0..6).map(|i| (i * 40) as f32).collect();
        for name in ["u1", "u2", "u2_big", "f8", "f4_big", "fortran", "version2"] {
            let a = read_npy(&golden(name)).unwrap();
            assert_eq!((a.shape.clone(), a.into_f32()), (vec![2, 3], counts.clone()), "{name}");
        }
        assert!(matches!(read_npy(&golden("u2_big")).unwrap().samples, Values::U16(_)));
    }

    #[test]
    fn fortran_order_of_three_axes_is_transposed() {
        let stored: Vec<usize> =
            vec![0, 12, 4, 16, 8, 20, 1, 13, 5, 17, 9, 21, 2, 14, 6, 18, 10, 22, 3, 15, 7, 19, 11, 23];
        assert_eq!(c_order(&[2, 3, 4], &stored), (0..24).collect::<Vec<_>>());
    }

    #[test]
    fn malformed_files_are_refused_with_what_was_found() {
        let dict =
            |descr: &str, shape: &str| format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
        let good = dict("'<f4'", "(2,)");
        let table: &[(&str, Vec<u8>, &str)] = &[
            ("empty", Vec::new(), "header is cut short"),
            ("text", b"a text file".to_vec(), "file type is [61, 20, 74"),
            ("version", b"\x93NUMPY\x09\x00\x00\x00".to_vec(), "NPY version is 9"),
            ("long header", b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(), "4294967295 bytes long"),
            ("cut header", file(&good, &[])[..40].to_vec(), "cut short"),
            ("truncated", file(&good, &[0; 7]), "takes 8 bytes after the header, the file holds 7"),
            ("trailing", file(&good, &[0; 9]), "the file holds 9"),
            ("absurd", file(&dict("'<f4'", "(1000000000, 1000000000)"), &[0; 8]), "takes 4000000000000000000 bytes"),
            ("overflow", file(&dict("'<f8'", &format!("({})", "9999999999, ".repeat(9))), &[0; 8]), "the file holds 8"),
            ("too big an axis", file(&dict("'<f4'", "(99999999999999999999,)"), &[]), "header is"),
            ("negative", file(&dict("'<f4'", "(-1,)"), &[]), "header is"),
            ("no pixels", file(&dict("'<f4'", "(3, 0)"), &[]), "no axis of length 0"),
            ("integers", file(&dict("'<i4'", "(2,)"), &[0; 8]), "data type is <i4"),
            ("objects", file(&dict("'|O'", "(2,)"), &[0; 8]), "data type is |O"),
            ("record", file(&dict("[('a', '<f4')]", "(2,)"), &[0; 8]), "header is"),
            ("nested", file(&"(".repeat(4000), &[]), "header is"),
            ("no shape", file("{'descr': '<f4', 'fortran_order': False}", &[]), "header is"),
            (
                "unknown key",
                file("{'descr': '<f4', 'fortran_order': False, 'shape': (), 'a': 'b'}", &[0; 4]),
                "header is",
            ),
        ];
        for (name, bytes, expected) in table {
            let e = of_bytes(bytes).expect_err(name).to_string();
            assert!(e.starts_with("a.npy: ") && e.contains(expected), "{name}: {e}");
        }
    }

    #[test]
    fn no_single_byte_and_no_cut_makes_it_panic_or_read_too_much() {
        let good = file("{'descr': '<u2', 'fortran_order': True, 'shape': (2, 3), }\n", &[7; 12]);
        assert!(of_bytes(&good).is_ok());
        let check = |bytes: &[u8]| {
            if let Ok(a) = of_bytes(bytes) {
                assert!(a.shape.iter().product::<usize>() <= 12);
            }
        };
        for at in 0..good.len() {
            assert!(of_bytes(&good[..at]).is_err(), "cut at {at}");
            let mut bytes = good.clone();
            for value in 0..=255 {
                bytes[at] = value;
                check(&bytes);
            }
        }
    }

    #[test]
    fn a_folder_and_a_missing_file_are_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        assert!(read_npy(dir.path()).unwrap_err().to_string().contains("a folder, allowed: a regular file"));
        assert!(matches!(read_npy(&dir.path().join("a")), Err(ArrayError::Missing(_))));
    }

    #[test]
    fn a_wrong_shape_is_not_written() {
        let dir = tempfile::tempdir().unwrap();
        let e = write_npy(&dir.path().join("a.npy"), &[2, 2], &[0.0; 3]).unwrap_err().to_string();
        assert!(e.ends_with("3 values cannot have the shape [2, 2]"), "{e}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
