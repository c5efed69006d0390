//! Modules import only what stands before them in the order of their package. Cargo checks the direction between packages; this test
//! reads the sources for the direction within them.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The modules of each package: each imports those before it alone.
const ORDER: [(&str, &[&str]); 2] = [
    (
        "crates/core/src",
        &[
            "image",
            "parallel",
            "polarization",
            "optics",
            "device",
            "frame",
            "readings",
            "guide",
            "solve",
            "refine",
            "uncertainty",
            "diagnose",
            "pipeline",
            "calibrate",
        ],
    ),
    (
        "src",
        &[
            "config", "files", "heap", "bundle", "model", "board", "camera", "output", "evaluate", "session", "live",
            "plan", "cli",
        ],
    ),
];
/// Gathers the failures of all modules, and whoever ends a command speaks in its terms: the one circle there is.
const ERRORS: &str = "error";

/// The modules that code imports, by the paths in it that begin with `crate`.
fn imports(code: &str) -> BTreeSet<String> {
    let names = |text: &str| text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let rest = code[at + 7..].trim_start();
        let Some(group) = rest.strip_prefix('{') else {
            found.insert(names(rest));
            continue;
        };
        let (mut depth, mut first) = (0, true);
        for (i, c) in group.char_indices() {
            match c {
                '}' if depth == 0 => break,
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => first = true,
                c if first && !c.is_whitespace() => {
                    found.insert(names(&group[i..]));
                    first = false;
                }
                _ => {}
            }
        }
    }
    // The root gives out one type of a module.
    if found.remove("Error") {
        found.insert("error".to_owned());
    }
    found
}

/// Source without comments and what stands in quotes.
fn code_only(source: &str) -> String {
    let (mut code, mut rest) = (String::new(), source);
    while let Some(c) = rest.chars().next() {
        let skipped = match c {
            '/' if rest.starts_with("//") => rest.find('\n').unwrap_or(rest.len()),
            '/' if rest.starts_with("/*") => rest.find("*/").map_or(rest.len(), |end| end + 2),
            'r' if rest.starts_with("r\"") || rest.starts_with("r#\"") => {
                let end = if rest.starts_with("r#") { "\"#" } else { "\"" };
                rest[3..].find(end).map_or(rest.len(), |at| 3 + at + end.len())
            }
            '"' => {
                let mut escaped = false;
                let end = rest[1..].find(|c: char| {
                    let end = c == '"' && !escaped;
                    escaped = c == '\\' && !escaped;
                    end
                });
                end.map_or(rest.len(), |end| end + 2)
            }
            // A quoted character; otherwise it is a lifetime.
            '\'' => match rest[1..].char_indices().nth(if rest[1..].starts_with('\\') { 2 } else { 1 }) {
                Some((end, '\'')) => end + 2,
                _ => 0,
            },
            _ => 0,
        };
        if skipped == 0 {
            code.push(c);
        }
        rest = &rest[if skipped == 0 { c.len_utf8() } else { skipped }..];
    }
    code
}

/// Code without the items that are compiled for tests only.
fn without_tests(code: &str) -> String {
    let mut kept = String::new();
    let mut rest = code;
    while let Some(at) = rest.find("#[cfg(test)]") {
        kept += &rest[..at];
        let item = &rest[at..];
        let mut depth = 0;
        let end = item.char_indices().find_map(|(i, c)| {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
            (depth == 0 && matches!(c, ';' | '}')).then_some(i + 1)
        });
        rest = &item[end.unwrap_or(item.len())..];
    }
    kept + rest
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<PathBuf> = entries
        .flat_map(|path| match () {
            () if path.is_dir() => sources(&path),
            () if path.extension().is_some_and(|e| e == "rs") => vec![path],
            () => Vec::new(),
        })
        .collect();
    files.sort();
    files
}

#[test]
fn a_module_imports_only_what_stands_before_it() {
    for (package, order) in ORDER {
        let src = Path::new(env!("CARGO_MANIFEST_DIR")).join(package);
        let mut seen = BTreeSet::new();
        for path in sources(&src) {
            let file = path.strip_prefix(&src).unwrap();
            let first = file.components().next().unwrap().as_os_str().to_str().unwrap();
            let module = first.strip_suffix(".rs").unwrap_or(first).to_owned();
            if ["lib", "main", ERRORS].contains(&module.as_str()) {
                continue;
            }
            let place = |name: &str| {
                let found = order.iter().position(|module| *module == name);
                found.unwrap_or_else(|| panic!("{package}: {name} has no place in the order: give it one"))
            };
            let code = without_tests(&code_only(&std::fs::read_to_string(&path).unwrap()));
            let root = file.components().count() == 1 || file.ends_with("mod.rs") && file.components().count() == 2;
            assert!(!root || !code.contains("super::"), "{package}/{}: leaves its module by `super`", file.display());
            for other in imports(&code).into_iter().filter(|name| *name != module && name != ERRORS) {
                let before = place(&other) < place(&module);
                assert!(before, "{package}/{}: {module} imports {other}, which comes after it", file.display());
            }
            seen.insert(module);
        }
        assert_eq!(seen.len(), order.len(), "{package}: the order names modules that are not there");
    }
}

/// Files and folders directly in a room, and those of the same room that each imports.
fn parts(room: &str) -> BTreeMap<String, BTreeSet<String>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src").join(room);
    let mut parts = BTreeMap::<_, BTreeSet<_>>::new();
    for path in sources(&folder) {
        let file = path.strip_prefix(&folder).unwrap();
        let first = file.components().next().unwrap().as_os_str().to_str().unwrap();
        let part = first.strip_suffix(".rs").unwrap_or(first).to_owned();
        // the file of the room itself only names its parts
        if part == "mod" {
            continue;
        }
        // in a file of a folder, `super` is the folder: what lies beyond is named from the crate's root
        let depth = file.components().count() - usize::from(file.ends_with("mod.rs"));
        let code = without_tests(&code_only(&std::fs::read_to_string(&path).unwrap()));
        let code = code.replace(&format!("crate::{room}::"), "room::");
        let code = if depth == 1 { code.replace("super::", "room::") } else { code };
        let imported = imports(&code.replace("crate::", "").replace("room::", "crate::"));
        parts.entry(part.clone()).or_default().extend(imported.into_iter().filter(|name| *name != part));
    }
    parts
}

#[test]
fn parts_of_a_room_do_not_import_in_a_circle() {
    for room in ["session", "live", "live/preview", "live/http"] {
        let mut left = parts(&room.replace('/', std::path::MAIN_SEPARATOR_STR));
        assert!(left.len() >= 3 && left.values().any(|imported| !imported.is_empty()), "{room}: {left:?}");
        while !left.is_empty() {
            let free = |imported: &BTreeSet<String>| imported.iter().all(|other| !left.contains_key(other));
            let done: Vec<_> = left.iter().filter(|(_, imported)| free(imported)).map(|(p, _)| p.clone()).collect();
            assert!(!done.is_empty(), "a circle among {left:?}");
            left.retain(|part, _| !done.contains(part));
        }
    }
}

#[test]
fn the_method_depends_on_nothing_that_belongs_to_a_program() {
    let cargo = Command::new(env!("CARGO"))
        .args(["tree", "--package", "stokescope-core", "--edges", "normal", "--no-default-features"])
        .args(["--prefix", "none", "--format", "{p}", "--locked", "--offline"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(cargo.status.success(), "{}", String::from_utf8_lossy(&cargo.stderr));
    let tree = String::from_utf8(cargo.stdout).unwrap();
    assert!(tree.lines().any(|line| line.starts_with("rustfft ")), "{tree}");
    for name in ["clap", "tokio", "hyper", "tracing", "toml", "tempfile", "signal-hook", "libc", "rustix", "image"] {
        assert!(
            !tree.lines().any(|line| line.starts_with(&format!("{name} "))),
            "stokescope-core depends on {name}:\n{tree}"
        );
    }
}

#[test]
fn the_reader_sees_through_groups_strings_comments_and_tests() {
    let source = r#"
        use crate::{
            files::{self, ArrayError}, bundle::Bundle,
            model,
        };
        //! [`crate::cli`] use crate::plan;
        const TEXT: &str = "crate::output \" crate::evaluate";
        fn f<'a>(q: char) -> bool { q == '"' || q == '\'' || g(crate::board::Board::load) }
        #[cfg(test)]
        mod tests { use crate::live; fn t() { use crate::cli::X; } }
        fn h() -> Result<(), crate::Error> { my_crate::camera() }
    "#;
    let found = imports(&without_tests(&code_only(source)));
    assert_eq!(found.into_iter().collect::<Vec<_>>(), ["board", "bundle", "error", "files", "model"]);
}

#[test]
fn every_test_of_a_fault_exists_and_every_numbered_test_is_in_the_table() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let table = std::fs::read_to_string(root.join("docs/faults.md")).unwrap();
    let mut named = BTreeSet::new();
    for row in table.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| #")) {
        let number: usize = row.split('|').nth(1).unwrap().trim().parse().unwrap();
        let before = named.len();
        for (file, test) in row.split('`').filter_map(|quoted| quoted.split_once("::")) {
            let source = std::fs::read_to_string(root.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"));
            let function = format!("fn {test}()");
            let at = source.find(&function).unwrap_or_else(|| panic!("fault {number}: {file} has no test {test}"));
            let attributes = source[..at].rsplit("\n\n").next().unwrap();
            assert!(attributes.contains("#[test]") || test == "main", "fault {number}: {file}::{test} is no test");
            assert!(
                !test.starts_with("fault_") || test.starts_with(&format!("fault_{number:02}_")),
                "{number}: {test}"
            );
            named.insert((number, file.to_owned(), test.to_owned()));
        }
        assert!(named.len() > before, "fault {number} has no test");
    }
    for folder in ["src", "tests", "crates"] {
        for path in sources(&root.join(folder)) {
            let source = std::fs::read_to_string(&path).unwrap();
            for (at, _) in source.match_indices(&["fn ", "fault_"].concat()) {
                let test: String = source[at + 3..].chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                assert!(
                    named.iter().any(|(.., known)| *known == test),
                    "{}: {test} is not in the table",
                    path.display()
                );
            }
        }
    }
}
