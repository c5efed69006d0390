//! `stokescope doctor`: checks whether a board can run, and names remedies for problems.

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::exposure;
use crate::Error;
use crate::board::{Board, BundleSource, CameraSpec};
use crate::bundle::Bundle;
use crate::camera::{self, CameraError, Clock, Request, Role};
use crate::files::WriteError;
use crate::live::ServiceError;
use stokescope_core::image::Stack;
use stokescope_core::readings::unpack;

/// Time limit for the first frame of a camera.
const FIRST_FRAME: Duration = Duration::from_secs(5);

/// Variable that names libcamera's configuration on a Raspberry Pi.
const PATIENCE_FILE: &str = "LIBCAMERA_RPI_CONFIG_FILE";
/// Wait for a trigger that is long enough for most.
const PATIENCE_MS: u64 = 600_000;

/// Check whether a board can run, and name remedies for problems.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or a board file.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Folder for the results.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Address of the preview.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
}

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Fine,
    /// The board runs, but not well.
    Warning,
    Problem,
}

/// Result of one check.
#[derive(Clone, Debug, Serialize)]
struct Finding {
    check: &'static str,
    verdict: Verdict,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    remedy: Option<&'static str>,
    #[serde(skip)]
    code: u8,
}

impl Finding {
    fn fine(check: &'static str, found: String) -> Self {
        Self { check, verdict: Verdict::Fine, found, remedy: None, code: 0 }
    }

    fn of(check: &'static str, outcome: Result<String, Error>, remedy: &'static str) -> Self {
        match outcome {
            Ok(found) => Self::fine(check, found),
            Err(e) => {
                let (found, code) = (e.to_string(), e.exit_code());
                Self { check, verdict: Verdict::Problem, found, remedy: Some(remedy), code }
            }
        }
    }
}

/// Runs all checks, prints the findings, and fails with the exit code of the first problem.
///
/// # Errors
/// [`Error::Unhealthy`] when there is a problem.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let findings = examine(args);
    if json {
        println!("{}", serde_json::json!({ "board": args.board, "findings": findings }));
    } else {
        for f in &findings {
            let mark = match f.verdict {
                Verdict::Fine => "fine",
                Verdict::Warning => "warning",
                Verdict::Problem => "PROBLEM",
            };
            println!("{mark:8} {:12} {}", f.check, f.found);
            f.remedy.iter().for_each(|remedy| println!("{:21} → {remedy}", ""));
        }
    }
    let problems: Vec<_> = findings.iter().filter(|f| f.verdict == Verdict::Problem).collect();
    match problems.first() {
        Some(first) => Err(Error::Unhealthy { problems: problems.len(), code: first.code }),
        None => Ok(()),
    }
}

fn examine(args: &Args) -> Vec<Finding> {
    let mut findings = Vec::new();
    match Board::load(&args.board) {
        Ok(board) => {
            findings.push(Finding::fine("board", format!("{}: {}", board.name, board.description)));
            findings.push(memory(board.memory_limit_bytes, available_bytes()));
            findings.push(cores(board.threads, std::thread::available_parallelism().map_or(1, usize::from)));
            if let BundleSource::Folder(dir) = &board.calibration {
                let loaded = Bundle::load(dir).map(|c| format!("{}: {}", dir.display(), c.name));
                let remedy = "make or repair the bundle: stokescope calibrate --help";
                findings.push(Finding::of("calibration", loaded.map_err(Error::from), remedy));
            }
            let clock = Clock::default();
            // a bundle that cannot be read is a finding already
            let orientation = board.orientation().ok().flatten();
            let open = |check, role, spec| open(check, spec, &Request::of(role, spec, &clock, orientation));
            findings.push(open("raw camera", Role::Raw, &board.raw));
            findings.extend(board.guide.as_ref().map(|spec| open("guide camera", Role::Guide, spec)));
            let cameras = std::iter::once(&board.raw).chain(&board.guide);
            if cameras.clone().any(|spec| spec.timing.triggered && spec.backend == "libcamera") {
                findings.push(patience(std::env::var_os(PATIENCE_FILE).map(PathBuf::from).as_deref()));
            }
        }
        Err(e) => {
            let remedy = "stokescope boards lists the shipped ones; --board also takes the path of a file";
            findings.push(Finding::of("board", Err(e.into()), remedy));
        }
    }
    let bound = TcpListener::bind(args.listen).map(|_| format!("{} is free", args.listen));
    let listen = bound.map_err(|source| ServiceError::Listen { listen: args.listen, source }.into());
    findings.push(Finding::of("preview", listen, "end the other program, or choose --listen 127.0.0.1:0"));
    let remedy = "choose a folder on a writable disk with --out, or make this one writable";
    findings.push(Finding::of("output", writable(&args.out), remedy));
    findings
}

fn open(check: &'static str, spec: &CameraSpec, request: &Request) -> Finding {
    let opened = camera::open(&spec.backend, request).and_then(|mut camera| {
        let info = camera.info().clone();
        let begin = Instant::now();
        let frame = camera.next_frame(FIRST_FRAME)?;
        let seconds = begin.elapsed().as_secs_f32();
        let mut planes = Stack::zeros(info.format.planes(), info.format.plane_size(info.size));
        let backend = |reason: String| CameraError::Backend { name: spec.backend.clone(), reason };
        unpack(&frame, &mut planes).map_err(|e| backend(e.to_string()))?;
        let share = exposure::saturated(&planes, &info);
        let (asked, found) = (&request.mode, format!("{} of {}", info.format, info.size));
        let what = format!("{}: asked for {asked}, delivers {found}, a frame after {seconds:.1} s", info.name);
        Ok((format!("{what}, {:.1} % of its readings saturated", 100.0 * share), share))
    });
    let remedy = "check cable, power, permissions, and backend and source in the board file";
    match opened {
        Err(waits @ CameraError::Waiting { .. }) => Finding::fine(check, format!("{waits}, which is no fault")),
        Ok((found, share)) if share > exposure::WARN_SHARE => {
            Finding { check, verdict: Verdict::Warning, found, remedy: Some(exposure::REMEDY), code: 0 }
        }
        opened => Finding::of(check, opened.map(|(found, _)| found).map_err(Error::from), remedy),
    }
}

/// Checks that libcamera waits for triggers: without a setting in `file`, it stops a camera after a second of silence.
fn patience(file: Option<&Path>) -> Finding {
    const CHECK: &str = "trigger";
    let remedy = "write {\"version\": 1.0, \"target\": \"pisp\", \"pipeline_handler\": {\"camera_timeout_value_ms\": 3600000}} \
                  (\"bcm2835\" before the Raspberry Pi 5) into a file, and name it in LIBCAMERA_RPI_CONFIG_FILE";
    let warn = |found| Finding { check: CHECK, verdict: Verdict::Warning, found, remedy: Some(remedy), code: 0 };
    let Some(file) = file else {
        return warn(format!(
            "{PATIENCE_FILE} is not set: libcamera restarts a camera that waits a second for its trigger"
        ));
    };
    let text = std::fs::read_to_string(file).unwrap_or_default();
    match timeout_ms(&text) {
        Some(ms) if ms >= PATIENCE_MS => Finding::fine(CHECK, format!("libcamera waits {} s for a trigger", ms / 1000)),
        Some(ms) => {
            warn(format!("{}: camera_timeout_value_ms = {ms}, after which libcamera stops the camera", file.display()))
        }
        None => {
            warn(format!("{}: no camera_timeout_value_ms, so libcamera stops a camera after a second", file.display()))
        }
    }
}

/// Value of `camera_timeout_value_ms` in a configuration file of libcamera, which is YAML or JSON.
fn timeout_ms(text: &str) -> Option<u64> {
    let (_, after) = text.split_once("camera_timeout_value_ms")?;
    let value = after.trim_start_matches(['"', ':', ' ']);
    value.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
}

fn memory(limit: usize, available: Option<u64>) -> Finding {
    let mib = |bytes: u64| bytes >> 20;
    let limit = limit as u64;
    let Some(available) = available else {
        return Finding::fine(
            "memory",
            format!("limit {} MiB; this system does not report available memory", mib(limit)),
        );
    };
    let found = format!("limit {} MiB, available {} MiB", mib(limit), mib(available));
    if available >= limit {
        return Finding::fine("memory", found);
    }
    let remedy =
        Some("end other programs, raise the container's limit, or lower memory.limit_bytes and the frame size");
    Finding { check: "memory", verdict: Verdict::Problem, found, remedy, code: 78 }
}

fn cores(threads: usize, cores: usize) -> Finding {
    let found = format!("{threads} solver threads on {cores} cores");
    if threads <= cores {
        return Finding::fine("cores", found);
    }
    let remedy = Some("lower solver.threads to the number of cores; more threads are slower");
    Finding { check: "cores", verdict: Verdict::Warning, found, remedy, code: 0 }
}

/// Memory available to this process in bytes, within the system and the innermost control group.
fn available_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let system = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?.trim().strip_suffix("kB")?;
    let system = system.trim().parse::<u64>().ok()? * 1024;
    Some(group_bytes().map_or(system, |group| group.min(system)))
}

/// Memory left in the control group (version 2) in bytes; `None` without a limit.
fn group_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let path = text.lines().find_map(|line| line.strip_prefix("0::"))?.trim_start_matches('/');
    let folder = Path::new("/sys/fs/cgroup").join(path);
    let read = |name| std::fs::read_to_string(folder.join(name)).ok()?.trim().parse::<u64>().ok();
    Some(read("memory.max")?.saturating_sub(read("memory.current")?))
}

/// Checks that files can be created in `dir`, or in its nearest parent that exists. No file remains.
fn writable(dir: &Path) -> Result<String, Error> {
    let absolute = std::path::absolute(dir).unwrap_or_else(|_| dir.to_path_buf());
    let existing = absolute.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    match tempfile::tempfile_in(existing) {
        Ok(_) => Ok(format!("{} is writable", dir.display())),
        Err(source) => Err(WriteError::Create { path: dir.to_path_buf(), source }.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_beyond_the_machine_are_found() {
        assert_eq!(memory(64 << 20, Some(63 << 20)).verdict, Verdict::Problem);
        assert_eq!(memory(64 << 20, Some(64 << 20)).verdict, Verdict::Fine);
        assert_eq!(cores(4, 2).verdict, Verdict::Warning);
        assert_eq!(cores(2, 2).verdict, Verdict::Fine);
    }

    #[test]
    fn each_problem_has_a_remedy_and_the_first_gives_the_exit_code() {
        let dir = tempfile::tempdir().unwrap();
        let (file, taken) = (dir.path().join("file"), TcpListener::bind("127.0.0.1:0").unwrap());
        std::fs::write(&file, "").unwrap();
        let args = Args { board: "nowhere".into(), out: file.join("out"), listen: taken.local_addr().unwrap() };
        let findings = examine(&args);
        let problems: Vec<_> = findings.iter().map(|f| (f.check, f.code, f.remedy.is_some())).collect();
        assert_eq!(problems, [("board", 66, true), ("preview", 69, true), ("output", 73, true)]);
        assert_eq!(run(&args, true).unwrap_err().exit_code(), 66);
    }

    #[test]
    fn whether_libcamera_waits_for_triggers_is_told() {
        let dir = tempfile::tempdir().unwrap();
        let with = |text: &str| {
            let file = dir.path().join("rpi.yaml");
            std::fs::write(&file, text).unwrap();
            patience(Some(&file))
        };
        let long = with(r#"{"version":1.0,"target":"pisp","pipeline_handler":{"camera_timeout_value_ms": 3600000}}"#);
        assert_eq!(long.verdict, Verdict::Fine, "{long:?}");
        assert_eq!(with("camera_timeout_value_ms: 5000").verdict, Verdict::Warning);
        assert_eq!(with("{}").verdict, Verdict::Warning);
        let unset = patience(None);
        assert!(unset.remedy.unwrap().contains("camera_timeout_value_ms\": 3600000"), "{unset:?}");
    }

    #[test]
    fn a_camera_that_is_exposed_too_long_is_warned_of() {
        let bright = |source: &str| {
            let spec = CameraSpec::new("sim", source.into());
            open("raw camera", &spec, &Request::of(Role::Raw, &spec, &Clock::default(), None))
        };
        let found = bright("film,size=48,light=10");
        assert!(found.verdict == Verdict::Warning && found.found.contains("% of its readings saturated"), "{found:?}");
        assert_eq!(bright("film,size=48").verdict, Verdict::Fine);
    }

    #[test]
    fn the_simulated_board_is_fine() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a/b");
        let args = Args { board: "x86-sim".into(), out: out.clone(), listen: "127.0.0.1:0".parse().unwrap() };
        let findings = examine(&args);
        assert_eq!(findings.len(), 7);
        assert!(findings.iter().all(|f| f.verdict != Verdict::Problem), "{findings:?}");
        assert!(!out.exists());
    }
}
