//! Lines on standard output.

use std::fmt;
use std::io::{self, Write};
use std::process::exit;

/// Exit code when standard output cannot be written.
const CANNOT_WRITE: i32 = 74;

/// Prints a line on standard output, as the macro of the standard library does, but without a panic when it cannot be written.
macro_rules! println {
    () => { $crate::cli::stdout::line(::std::format_args!("")) };
    ($($text:tt)*) => { $crate::cli::stdout::line(::std::format_args!($($text)*)) };
}

/// Writes a line. Ends the program when nobody reads it any more, quietly, or when the disk is full.
pub(super) fn line(text: fmt::Arguments<'_>) {
    let mut out = io::stdout().lock();
    let Err(e) = writeln!(out, "{text}").and_then(|()| out.flush()) else { return };
    drop(out);
    if e.kind() == io::ErrorKind::BrokenPipe {
        exit(0);
    }
    tracing::error!("standard output: {e}");
    exit(CANNOT_WRITE);
}
