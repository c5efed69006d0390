//! Digest of a bundle's content.

use sha2::{Digest, Sha256};

/// SHA-256 over the lengths and bytes of all `parts`, as hexadecimal digits.
pub(super) fn of<'a>(parts: impl IntoIterator<Item = &'a [u8]>) -> String {
    let mut hash = Sha256::new();
    for part in parts {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
