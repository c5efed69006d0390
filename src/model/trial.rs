//! Trial of a network that is not shipped, in a process of its own with bounds on memory and time.
//!
//! A small file can describe a network that takes gigabytes or minutes to analyse, and what the engine does not expect ends a program that
//! is built to abort. The program therefore starts itself again to open the network once, and opens it only if that process ended by
//! itself. Libraries that use this package open networks directly: [`guard`] is for programs with the hidden command `trial`.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use super::{ModelError, Precision};

/// Most memory that the analysis of a network may take, in bytes.
pub const MAX_MEMORY: u64 = 512 << 20;
/// Most time that the analysis of a network may take.
pub const MAX_TIME: Duration = Duration::from_secs(30);
/// Pace of the looks at the process.
const PACE: Duration = Duration::from_millis(5);
/// Exit codes of this program, and of other Rust programs, after a panic or without memory.
const DEFECTS: [i32; 2] = [70, 101];

static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Tries networks in a process of this program from now on.
pub fn guard() {
    if let Ok(program) = std::env::current_exe() {
        // a second call changes nothing
        let _ = PROGRAM.set(program);
    }
}

/// Tries the network of a manifest; `file` is its ONNX file.
///
/// # Errors
/// [`ModelError::Costly`] when it takes too much memory or time or ends the process. Other errors are those of opening the network here.
pub(super) fn run(manifest: &Path, precision: Precision, file: &Path) -> Result<(), ModelError> {
    let Some(program) = PROGRAM.get() else { return Ok(()) };
    let mut command = Command::new(program);
    command.arg("trial").arg(manifest).arg(precision.to_string());
    let problem = watch(&mut command, MAX_MEMORY, MAX_TIME);
    match problem.map_err(|source| ModelError::Io { file: program.clone(), source })? {
        None => Ok(()),
        Some(problem) => Err(ModelError::Costly { file: file.to_path_buf(), problem }),
    }
}

/// Runs a command within bounds; gives the reason why it did not end by itself, if so.
fn watch(command: &mut Command, most_memory: u64, most_time: Duration) -> std::io::Result<Option<String>> {
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    let begin = Instant::now();
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(crashed(status));
        }
        let problem = if memory(&child) > most_memory {
            "takes too much memory"
        } else if begin.elapsed() > most_time {
            "takes too long"
        } else {
            std::thread::sleep(PACE);
            continue;
        };
        // it may have ended in this moment
        let _ = child.kill();
        child.wait()?;
        return Ok(Some(problem.to_owned()));
    }
}

/// Bytes of memory that a process holds; 0 where the system does not tell.
fn memory(child: &Child) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kilobytes = resident.and_then(|text| text.trim().trim_end_matches(" kB").parse::<u64>().ok());
    kilobytes.unwrap_or(0) << 10
}

/// The reason why a process did not end by itself.
fn crashed(status: ExitStatus) -> Option<String> {
    match status.code() {
        Some(code) if !DEFECTS.contains(&code) => None,
        _ => Some(format!("takes too much memory or ends the process that does it ({status})")),
    }
}

/// Bounds the memory of this process, which is about to try a network. A system that refuses leaves the bound to the process that watches.
pub fn bound() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, Rlimit, setrlimit};
        let most = Some(2 * MAX_MEMORY);
        let _ = setrlimit(Resource::As, Rlimit { current: most, maximum: most });
    }
}

#[cfg(target_os = "linux")]
#[cfg(test)]
mod tests {
    use super::*;

    fn shell(text: &str) -> Option<String> {
        watch(Command::new("sh").args(["-c", text]), 64 << 20, Duration::from_secs(2)).unwrap()
    }

    #[test]
    fn a_process_that_takes_too_much_or_crashes_is_ended_and_named() {
        assert_eq!((shell("true"), shell("exit 65")), (None, None));
        let begin = Instant::now();
        assert_eq!(shell("sleep 60").as_deref(), Some("takes too long"));
        assert_eq!(shell("exec tail -n 1 /dev/zero").as_deref(), Some("takes too much memory"));
        assert!(begin.elapsed() < Duration::from_secs(20));
        for end in ["exit 70", "exit 101", "kill -ABRT $$"] {
            assert!(shell(end).unwrap().contains("ends the process"), "{end}");
        }
    }
}
