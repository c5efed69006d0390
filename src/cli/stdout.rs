//! Standard output, which may be a pipe whose reader has gone or a file on a full disk.

use std::fmt::Arguments;
use std::io::{self, ErrorKind, Write};

use parking_lot::Mutex;

use crate::Error;

/// Prints a line as the macro of the standard library does; a failure is reported when the command ends instead of a panic.
macro_rules! println {
    ($($text:tt)*) => { $crate::cli::stdout::write(::std::format_args!("{}\n", ::std::format_args!($($text)*))) };
}

/// The first failure; nothing is written after it.
static FAILURE: Mutex<Option<io::Error>> = Mutex::new(None);

/// Writes text.
pub(super) fn write(text: Arguments<'_>) {
    let mut failure = FAILURE.lock();
    if failure.is_none() {
        *failure = io::stdout().lock().write_fmt(text).err();
    }
}

/// Ends the output of a command. A reader that has gone, such as `head`, has read what it wants: that is no error.
///
/// # Errors
/// [`Error::Stdout`] when the output could not be written.
pub(super) fn finish() -> Result<(), Error> {
    let flushed = io::stdout().lock().flush();
    match FAILURE.lock().take().or(flushed.err()) {
        Some(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::Stdout(e)),
        _ => Ok(()),
    }
}
