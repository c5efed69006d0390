//! Rooms import only lower levels. Read from the sources, so that a short cut fails here and not in a review.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The rooms from the ground up. Rooms of one level do not import one another, but for those in [`NEIGHBOURLY`].
const LEVELS: [&[&str]; 5] = [
    &["plane", "config", "parallel", "heap"],
    &["array", "frame", "optics", "calibration", "board", "model"],
    &["camera", "prepare", "recon", "fusion", "polar", "output"],
    &["pipeline", "evaluate", "calibrate"],
    &["service", "plan", "cli", "error"],
];
/// Levels whose rooms build on one another, without a circle: the bundle is made of arrays and optics;
/// calibration reconstructs; commands end in errors.
const NEIGHBOURLY: [usize; 3] = [1, 3, 4];

/// The rooms that code imports, by the paths in it that begin with `crate`.
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
    // The root gives out one type of a room.
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

/// Rooms and the rooms they import, each with a file that does.
fn rooms() -> BTreeMap<String, BTreeMap<String, PathBuf>> {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut rooms = BTreeMap::<_, BTreeMap<_, _>>::new();
    for path in sources(&src) {
        let file = path.strip_prefix(&src).unwrap();
        let first = file.components().next().unwrap().as_os_str().to_str().unwrap();
        let room = first.strip_suffix(".rs").unwrap_or(first).to_owned();
        if room == "lib" || room == "main" {
            continue;
        }
        let code = without_tests(&code_only(&std::fs::read_to_string(&path).unwrap()));
        let root = file.components().count() == 1 || file.ends_with("mod.rs") && file.components().count() == 2;
        assert!(!root || !code.contains("super::"), "{}: leaves its room by `super`", file.display());
        let imported = rooms.entry(room.clone()).or_default();
        for name in imports(&code).into_iter().filter(|name| *name != room) {
            imported.insert(name, file.to_path_buf());
        }
    }
    rooms
}

fn level(room: &str) -> usize {
    LEVELS.iter().position(|rooms| rooms.contains(&room)).unwrap_or_else(|| panic!("{room} has no level: give it one"))
}

#[test]
fn a_room_imports_only_what_lies_below_it() {
    let rooms = rooms();
    assert!(rooms.len() >= 15, "only {} rooms found: {:?}", rooms.len(), rooms.keys());
    for (room, imported) in &rooms {
        let own = level(room);
        for (other, file) in imported {
            let other_level = level(other);
            let allowed = other_level < own || other_level == own && NEIGHBOURLY.contains(&own);
            assert!(allowed, "{}: {room} (level {own}) imports {other} (level {other_level})", file.display());
        }
    }
}

#[test]
fn neighbours_do_not_import_in_a_circle() {
    let mut left = rooms();
    // It gathers the failures of all rooms, and whoever ends a command speaks in its terms: the one circle there is.
    left.remove("error");
    while !left.is_empty() {
        let free = |imported: &BTreeMap<String, PathBuf>| imported.keys().all(|other| !left.contains_key(other));
        let done: Vec<String> =
            left.iter().filter(|(_, imported)| free(imported)).map(|(room, _)| room.clone()).collect();
        assert!(!done.is_empty(), "a circle among {:?}", left.keys());
        left.retain(|room, _| !done.contains(room));
    }
}

#[test]
fn the_reader_sees_through_groups_strings_comments_and_tests() {
    let source = r#"
        use crate::{
            array::{self, ArrayError}, plane::Size,
            optics,
        };
        //! [`crate::recon`] use crate::fusion;
        const TEXT: &str = "crate::output \" crate::polar";
        fn f<'a>(q: char) -> bool { q == '"' || q == '\'' || g(crate::board::Board::load) }
        #[cfg(test)]
        mod tests { use crate::service; fn t() { use crate::cli::X; } }
        fn h() -> Result<(), crate::Error> { my_crate::camera() }
    "#;
    let found = imports(&without_tests(&code_only(source)));
    assert_eq!(found.into_iter().collect::<Vec<_>>(), ["array", "board", "error", "optics", "plane"]);
}
