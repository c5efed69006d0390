//! What happened, as JSON lines: for watchers of `/events` and for the user's own command.

use std::io::Write;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use hyper::body::Bytes;
use serde_json::{Value, json};
use tokio::sync::broadcast;

/// Events that may wait for a slow reader; it loses the oldest then.
const WAITING: usize = 64;
/// Events a newcomer is told first.
const REMEMBERED: usize = 16;
/// A reader hears something at least this often, so that one that is gone is found out.
const HEARTBEAT: Duration = Duration::from_secs(15);
/// How long the user's command has to end when its input does.
const FAREWELL: Duration = Duration::from_secs(1);

/// The wall clock, for people: nothing is measured with it.
pub(super) fn wall_clock() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// The way of events out of the service.
#[derive(Debug)]
pub(super) struct Events {
    started: Instant,
    readers: broadcast::Sender<Bytes>,
    recent: Mutex<heapless::HistoryBuf<Bytes, REMEMBERED>>,
    command: Option<SyncSender<Bytes>>,
}

/// A reader of events.
#[derive(Debug)]
pub(super) struct Reading {
    before: Vec<Bytes>,
    next: broadcast::Receiver<Bytes>,
}

impl Events {
    /// Events that go to readers alone, or to a command too: then its end of the queue is given as well.
    pub(super) fn new(started: Instant, with_command: bool) -> (Self, Option<Receiver<Bytes>>) {
        let (command, queue) = with_command.then(|| sync_channel(WAITING)).unzip();
        let readers = broadcast::Sender::new(WAITING);
        (Self { started, readers, recent: Mutex::default(), command }, queue)
    }

    /// Tells everybody that `event` happened. Whoever is slow loses events, nobody waits.
    pub(super) fn emit(&self, event: &'static str, detail: Value) {
        let seconds = (self.started.elapsed().as_secs_f64() * 1e3).round() / 1e3;
        let mut line = json!({ "event": event, "time": wall_clock(), "uptime_seconds": seconds });
        if let (Some(line), Value::Object(detail)) = (line.as_object_mut(), detail) {
            line.extend(detail);
        }
        let line = Bytes::from(format!("{line}\n"));
        self.recent.lock().unwrap_or_else(PoisonError::into_inner).write(line.clone());
        if let Some(command) = &self.command {
            // a full queue is a command that does not read
            let _ = command.try_send(line.clone());
        }
        // an error is nobody reading
        let _ = self.readers.send(line);
    }

    /// The latest events, oldest first.
    pub(super) fn recent(&self) -> Vec<Value> {
        let recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        recent.oldest_ordered().filter_map(|line| serde_json::from_slice(line).ok()).collect()
    }

    /// Reads the latest events and all that follow.
    pub(super) fn read(&self) -> Reading {
        let recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        let mut before: Vec<_> = recent.oldest_ordered().cloned().collect();
        before.reverse();
        Reading { before, next: self.readers.subscribe() }
    }
}

impl Reading {
    /// The next line; an empty one when nothing happened for a while. None when the service ends.
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

/// Feeds events to the shell command `text`, which reads them line by line from its input. One that ended is started again
/// with the next event.
pub(super) fn run_command(text: &str, queue: &Receiver<Bytes>, ended: impl Fn() -> bool) {
    let mut running: Option<(Child, ChildStdin)> = None;
    while !ended() {
        let Ok(line) = queue.recv_timeout(Duration::from_millis(200)) else { continue };
        if running.is_none() {
            running = start(text);
        }
        if let Some((_, input)) = &mut running
            && input.write_all(&line).and_then(|()| input.flush()).is_err()
        {
            finish(running.take());
            running = start(text);
            if let Some((_, input)) = &mut running {
                // a command that cannot even take one line is told of the next one
                let _ = input.write_all(&line);
            }
        }
    }
    queue.try_iter().for_each(|line| {
        if let Some((_, input)) = &mut running {
            // it may have ended before the service does
            let _ = input.write_all(&line);
        }
    });
    finish(running);
}

fn start(text: &str) -> Option<(Child, ChildStdin)> {
    let started = Command::new("sh").args(["-c", text]).stdin(Stdio::piped()).stdout(Stdio::null()).spawn();
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
    // it ended already when it reads its input
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
        // it reads one line and ends
        let text = format!("head -n 1 >> '{}'", file.display());
        let (events, queue) = Events::new(Instant::now(), true);
        let (queue, ended) = (queue.unwrap(), std::sync::Arc::new(AtomicBool::new(false)));
        let stop = ended.clone();
        let thread = std::thread::spawn(move || run_command(&text, &queue, || stop.load(Ordering::Relaxed)));
        let heard = || std::fs::read_to_string(&file).unwrap_or_default();
        for n in 1..=3 {
            let begin = Instant::now();
            // what falls into the moment of its end is lost: events say what happened, states are asked for
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
