//! The `stokescope` program.
fn main() {}
