//! Events of the service as JSON lines, for readers of `/events` and for the user's own command.

use std::io::Write;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use parking_lot::Mutex;
use serde_json::{Value, json};
use tokio::sync::broadcast;

use super::options::TOKEN_VARIABLE;
use crate::session::timestamp;

/// Events that may wait for a slow reader, which then loses the oldest.
const WAITING: usize = 64;
/// Latest events that a new reader gets first.
const REMEMBERED: usize = 16;
/// Longest time between two lines, so that a reader that is gone is found out.
const HEARTBEAT: Duration = Duration::from_secs(15);
/// Time that the user's command has to end after its input does.
const FAREWELL: Duration = Duration::from_secs(1);
/// Pace of the checks for the end of the service.
const PACE: Duration = Duration::from_millis(200);

/// Sender of events.
#[derive(Debug)]
pub(super) struct Events {
    started: Instant,
    readers: broadcast::Sender<Bytes>,
    recent: Mutex<heapless::HistoryBuf<Bytes, REMEMBERED>>,
    command: Option<SyncSender<Bytes>>,
}

/// Receiver of the latest events and all that follow.
#[derive(Debug)]
pub(super) struct EventReader {
    /// The latest events, newest first.
    before: Vec<Bytes>,
    next: broadcast::Receiver<Bytes>,
}

impl Events {
    /// Events for readers and, with `with_command`, for a command, which takes them out of the queue that is given too.
    pub(super) fn new(started: Instant, with_command: bool) -> (Self, Option<Receiver<Bytes>>) {
        let (command, queue) = with_command.then(|| sync_channel(WAITING)).unzip();
        let readers = broadcast::Sender::new(WAITING);
        (Self { started, readers, recent: Mutex::default(), command }, queue)
    }

    /// Sends an event with its details. Slow readers lose events; nobody waits.
    pub(super) fn emit(&self, event: &'static str, detail: Value) {
        let seconds = (self.started.elapsed().as_secs_f64() * 1e3).round() / 1e3;
        let mut line = json!({ "event": event, "time": timestamp(), "uptime_seconds": seconds });
        if let (Some(line), Value::Object(detail)) = (line.as_object_mut(), detail) {
            line.extend(detail);
        }
        let line = Bytes::from(format!("{line}\n"));
        self.recent.lock().write(line.clone());
        if let Some(command) = &self.command {
            // the queue is full when the command does not read
            let _ = command.try_send(line.clone());
        }
        // this fails when there are no readers
        let _ = self.readers.send(line);
    }

    /// The latest events, oldest first.
    pub(super) fn recent(&self) -> Vec<Value> {
        self.recent.lock().oldest_ordered().filter_map(|line| serde_json::from_slice(line).ok()).collect()
    }

    /// A new reader.
    pub(super) fn read(&self) -> EventReader {
        let recent = self.recent.lock();
        let mut before: Vec<_> = recent.oldest_ordered().cloned().collect();
        before.reverse();
        EventReader { before, next: self.readers.subscribe() }
    }
}

impl EventReader {
    /// Waits for the next line. Gives an empty line when nothing happened for a while and none when the service ends.
    pub(super) async fn next(&mut self) -> Option<Bytes> {
        if let Some(line) = self.before.pop() {
            return Some(line);
        }
        loop {
            match tokio::time::timeout(HEARTBEAT, self.next.recv()).await {
                Err(_) => return Some(Bytes::from_static(b"\n")),
                Ok(Ok(line)) => return Some(line),
                Ok(Err(broadcast::error::RecvError::Lagged(_))) => {}
                Ok(Err(broadcast::error::RecvError::Closed)) => return None,
            }
        }
    }
}

/// Feeds events to the shell command `text`, which reads them line by line from its input, until `ended`. A command that ended
/// is started again with the next event.
pub(super) fn run_command(text: &str, queue: &Receiver<Bytes>, ended: impl Fn() -> bool) {
    let mut running: Option<(Child, ChildStdin)> = None;
    while !ended() {
        let Ok(line) = queue.recv_timeout(PACE) else { continue };
        if running.is_none() {
            running = start(text);
        }
        if let Some((_, input)) = &mut running
            && input.write_all(&line).and_then(|()| input.flush()).is_err()
        {
            finish(running.take());
            running = start(text);
            if let Some((_, input)) = &mut running {
                // a command that does not take this line gets the next one
                let _ = input.write_all(&line);
            }
        }
    }
    queue.try_iter().for_each(|line| {
        if let Some((_, input)) = &mut running {
            // the command may have ended before the service does
            let _ = input.write_all(&line);
        }
    });
    finish(running);
}

fn start(text: &str) -> Option<(Child, ChildStdin)> {
    // commands that the user's command runs have no use for the token
    let mut command = Command::new("sh");
    command.args(["-c", text]).env_remove(TOKEN_VARIABLE);
    let started = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn();
    match started {
        Ok(mut child) => child.stdin.take().map(|input| (child, input)),
        Err(e) => {
            tracing::error!("event command `{text}`: {e}");
            None
        }
    }
}

/// Ends the command's input, then the command.
fn finish(running: Option<(Child, ChildStdin)>) {
    let Some((mut child, input)) = running else { return };
    drop(input);
    let deadline = Instant::now() + FAREWELL;
    while Instant::now() < deadline && matches!(child.try_wait(), Ok(None)) {
        std::thread::sleep(FAREWELL / 50);
    }
    // a command that reads its input has ended already
    let _ = child.kill();
    let _ = child.wait();
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};

    #[test]
    fn events_are_lines_of_json_and_the_latest_are_remembered() {
        let (events, _) = Events::new(Instant::now(), false);
        for n in 0..REMEMBERED + 4 {
            events.emit("test", json!({ "n": n }));
        }
        let recent = events.recent();
        assert_eq!((recent.len(), recent[0]["n"].as_u64(), recent[0]["event"].as_str()), (16, Some(4), Some("test")));
        let mut reading = events.read();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let first: Value = serde_json::from_slice(&runtime.block_on(reading.next()).unwrap()).unwrap();
        assert_eq!(first["n"], 4);
    }

    #[cfg(unix)]
    #[test]
    fn a_command_reads_every_event_and_one_that_ended_is_started_again() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("heard");
        // the command reads one line and ends
        let text = format!("head -n 1 >> '{}'", file.display());
        let (events, queue) = Events::new(Instant::now(), true);
        let (queue, ended) = (queue.unwrap(), std::sync::Arc::new(AtomicBool::new(false)));
        let stop = ended.clone();
        let thread = std::thread::spawn(move || run_command(&text, &queue, || stop.load(Ordering::Relaxed)));
        let heard = || std::fs::read_to_string(&file).unwrap_or_default();
        for n in 1..=3 {
            let begin = Instant::now();
            // an event in the moment of the command's end is lost
            while heard().lines().count() < n {
                events.emit("test", json!({ "n": n }));
                std::thread::sleep(Duration::from_millis(50));
                assert!(begin.elapsed() < Duration::from_secs(30), "{}", heard());
            }
        }
        ended.store(true, Ordering::Relaxed);
        thread.join().unwrap();
        assert!(heard().contains("\"event\":\"test\""));
    }
}
