//! Fault 23 of docs/faults.md: the targets of `fuzz/` on any toolchain, with their corpus and random changes of it, for some time each
//! (`STOKESCOPE_FUZZ_MS`). `scripts/fuzz.sh` runs the same targets guided by coverage.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a test")]

#[path = "../fuzz/src/lib.rs"]
mod targets;

use std::path::Path;
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng, rngs::StdRng};

/// Name and parser.
type Target = (&'static str, fn(&[u8]));

/// No input may take longer, on the slowest machine.
const SLOW: Duration = Duration::from_secs(20);
/// Nor hold so much: the largest image that is read has 64 Mi pixels, but a file of some kilobytes cannot hold them.
const MUCH: u64 = 192 << 20;

fn corpus(target: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    files.iter().map(|file| std::fs::read(file).unwrap()).collect()
}

/// A few random changes: bytes, cuts, repetitions, pieces of another file, numbers at their limits.
fn mutate(random: &mut StdRng, bytes: &mut Vec<u8>, other: &[u8]) {
    for _ in 0..random.random_range(1..6) {
        let at = random.random_range(0..=bytes.len());
        let end = (at + random.random_range(0..16)).min(bytes.len());
        match random.random_range(0..6) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes.truncate(at),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            4 if !other.is_empty() => {
                let from = random.random_range(0..other.len());
                let piece = &other[from..(from + random.random_range(1..32)).min(other.len())];
                bytes.splice(at..end, piece.iter().copied());
            }
            _ => {
                let limits: [&[u8]; 6] = [b"-1", b"1e39", b"99999999999999999999", &[0xff; 4], &[0; 8], b"nan"];
                bytes.splice(at..end, limits[random.random_range(0..limits.len())].iter().copied());
            }
        }
    }
    bytes.truncate(32 << 10);
}

#[test]
fn fault_23_no_bytes_make_a_parser_panic_hang_or_take_much_memory() {
    let moment = std::env::var("STOKESCOPE_FUZZ_MS").ok().and_then(|v| v.parse().ok()).unwrap_or(1500);
    let all: [Target; 8] = [
        ("board", targets::board),
        ("bundle", targets::bundle),
        ("manifest", targets::manifest),
        ("npy", targets::npy),
        ("image", targets::image),
        ("request", targets::request),
        ("session", targets::session),
        ("model", |bytes| targets::model(Path::new(env!("CARGO_BIN_EXE_stokescope")), bytes)),
    ];
    // networks are opened where there is an engine
    for (name, target) in all.into_iter().filter(|(name, _)| cfg!(feature = "fusion") || *name != "model") {
        let (corpus, mut random) = (corpus(name), StdRng::seed_from_u64(23));
        assert!(!corpus.is_empty(), "{name} has no corpus");
        let (begin, mut inputs) = (Instant::now(), 0);
        let mut run = |bytes: &[u8]| {
            let begin = Instant::now();
            target(bytes);
            assert!(begin.elapsed() < SLOW, "{name}: {:?} for {bytes:?}", begin.elapsed());
            inputs += 1;
        };
        corpus.iter().for_each(|bytes| run(bytes));
        while begin.elapsed() < Duration::from_millis(moment) {
            let mut bytes = corpus[random.random_range(0..corpus.len())].clone();
            let other = &corpus[random.random_range(0..corpus.len())];
            mutate(&mut random, &mut bytes, other);
            run(&bytes);
        }
        println!("{name}: {inputs} inputs");
    }
    let peak = stokescope::output::peak_rss_bytes().unwrap();
    assert!(peak < MUCH, "{peak} bytes");
}
