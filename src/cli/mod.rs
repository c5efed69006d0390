//! L4: the command line, one file per command. Results go to stdout, everything else to stderr.

pub mod evaluate;
pub mod simulate;
