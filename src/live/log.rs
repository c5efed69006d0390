//! Latest lines of the log, for viewers that have no access to the machine.

use std::collections::VecDeque;
use std::io::{self, Write};

use parking_lot::Mutex;

/// Lines that are remembered, and bytes of each.
const LINES: usize = 200;
const LINE_BYTES: usize = 400;

static LATEST: Mutex<VecDeque<String>> = Mutex::new(VecDeque::new());

/// Writer that remembers the latest lines written to it. Each write is one line.
#[derive(Clone, Copy, Debug, Default)]
pub struct LogTail;

impl Write for LogTail {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let kept = String::from_utf8_lossy(&line[..line.len().min(LINE_BYTES)]).trim_end().to_owned();
        let mut latest = LATEST.lock();
        if latest.len() >= LINES {
            latest.pop_front();
        }
        latest.push_back(format!("{} {kept}\n", crate::session::timestamp()));
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The latest lines, oldest first.
pub(super) fn latest() -> String {
    LATEST.lock().iter().map(String::as_str).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_lines_are_remembered_and_none_is_too_long() {
        let mut tail = LogTail;
        for n in 0..LINES + 5 {
            tail.write_all(format!("line {n} {}\n", "x".repeat(LINE_BYTES)).as_bytes()).unwrap();
        }
        let text = latest();
        assert!(text.lines().count() == LINES && text.lines().all(|line| line.len() < 2 * LINE_BYTES));
        assert!(!text.contains("line 4 ") && text.contains(&format!("line {} ", LINES + 4)));
    }
}
