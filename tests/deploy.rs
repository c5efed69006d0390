//! The files of `deploy/`: the unit says what the documents promise, and systemd takes it.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::Path;
use std::process::Command;

fn deployed(name: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(name)).unwrap()
}

/// Values of a key in a section of a unit.
fn values<'a>(unit: &'a str, section: &str, key: &str) -> Vec<&'a str> {
    let (mut current, mut found) = ("", Vec::new());
    for line in unit.lines().map(str::trim) {
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            current = name;
        } else if let Some((name, value)) = line.split_once('=')
            && (current, name) == (section, key)
        {
            found.push(value);
        }
    }
    found
}

#[test]
fn the_unit_is_restarted_for_ever_with_growing_pauses_and_not_after_wrong_options() {
    let unit = deployed("stokescope.service");
    let value = |section, key| values(&unit, section, key);
    assert_eq!(value("Unit", "StartLimitIntervalSec"), ["0"], "no number of failures stops the unit for good");
    assert!(value("Unit", "StartLimitBurst").is_empty() && value("Service", "StartLimitIntervalSec").is_empty());
    assert_eq!(value("Service", "Restart"), ["on-failure"]);
    let number = |key| value("Service", key).concat().parse::<u32>().unwrap();
    let (first, steps, longest) = (number("RestartSec"), number("RestartSteps"), number("RestartMaxDelaySec"));
    assert!((1..=5).contains(&first) && (2..=10).contains(&steps) && (30..=120).contains(&longest));
    let ends: Vec<_> = value("Service", "RestartPreventExitStatus")[0].split_whitespace().map(str::to_owned).collect();
    assert_eq!(ends, ["2", "64", "65", "66", "78"]);
}

#[test]
fn systemd_takes_the_unit() {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        println!("skipped: systemd-analyze is not installed");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("stokescope.service");
    // the program stands where it was built
    let unit = deployed("stokescope.service").replace("/usr/bin/stokescope", env!("CARGO_BIN_EXE_stokescope"));
    std::fs::write(&path, unit).unwrap();
    let output = Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&path).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    // keys of later versions of systemd are ignored, as the unit says
    let about = |line: &&str| {
        line.contains("stokescope.service") && !line.contains("RestartSteps") && !line.contains("RestartMaxDelaySec")
    };
    let problems: Vec<_> = text.lines().filter(about).collect();
    assert!(output.status.success() && problems.is_empty(), "{text}");
    let output =
        Command::new("systemd-analyze").args(["security", "--offline=true", "--threshold=15"]).arg(&path).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn everything_that_the_unit_may_open_is_handed_over_by_the_rules_and_the_package() {
    let (rules, postinst) = (deployed("60-stokescope.rules"), deployed("debian/postinst"));
    for (subsystem, class) in [("video4linux", "video4linux"), ("media", "media"), ("dma_heap", "dma_heap")] {
        assert!(rules.contains(&format!("SUBSYSTEM==\"{subsystem}\"")), "{rules}");
        assert!(postinst.contains(&format!("--subsystem-match={class}")), "{postinst}");
    }
}

#[test]
fn avahi_names_the_port_that_the_service_listens_at_and_the_document_has_the_file() {
    let (file, cli) = (deployed("avahi/stokescope.service"), deployed("../src/cli/run.rs"));
    let port = file.split("<port>").nth(1).unwrap().split('<').next().unwrap();
    assert!(cli.contains(&format!("default_value = \"127.0.0.1:{port}\"")), "{port}");
    assert!(file.contains("<type>_http._tcp</type>"));
    assert!(deployed("../docs/deploy.md").contains(&file));
    let package = deployed("../Cargo.toml");
    assert!(package.contains("[\"deploy/avahi/stokescope.service\", \"usr/share/doc/stokescope/examples/\", \"644\"]"));
}
