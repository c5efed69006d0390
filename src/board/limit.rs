//! Memory limits that the operating system sets for this process.

use std::path::Path;

use rustix::process::{Resource, getrlimit};

/// A memory limit set by the operating system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SystemLimit {
    /// Largest size of the whole process in bytes.
    pub bytes: usize,
    /// Name of the limit for messages.
    pub source: &'static str,
}

impl SystemLimit {
    /// Smallest limit of this process: that of its control groups (version 2 or 1) or the resource limit on data. `None` without
    /// any limit. `reserved` bytes are subtracted from the resource limit, because it counts the full size of all stacks.
    pub fn of_this_process(reserved: usize) -> Option<Self> {
        let data = getrlimit(Resource::Data).current;
        let data = data.map(|bytes| Self {
            bytes: usize::try_from(bytes).unwrap_or(usize::MAX).saturating_sub(reserved),
            source: "the resource limit on data",
        });
        data.into_iter().chain(control_group(Path::new("/"))).min_by_key(|limit| limit.bytes)
    }
}

/// Smallest limit of the control groups that contain this process; files are read below `root`.
fn control_group(root: &Path) -> Option<SystemLimit> {
    let groups = std::fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    let mut smallest: Option<usize> = None;
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else { continue };
        let (folder, file) = match controllers {
            "" => ("sys/fs/cgroup", "memory.max"),
            c if c.split(',').any(|c| c == "memory") => ("sys/fs/cgroup/memory", "memory.limit_in_bytes"),
            _ => continue,
        };
        let top = root.join(folder);
        let group = top.join(path.trim_start_matches('/'));
        for folder in group.ancestors().take_while(|folder| folder.starts_with(&top)) {
            let text = std::fs::read_to_string(folder.join(file)).unwrap_or_default();
            // "max" means no limit; version 1 writes a number larger than any memory instead
            let limit = text.trim().parse::<usize>().ok().filter(|bytes| *bytes < usize::MAX / 4);
            smallest = [smallest, limit].into_iter().flatten().min();
        }
    }
    smallest.map(|bytes| SystemLimit { bytes, source: "the control group" })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, file: &str, text: &str) {
        let path = root.join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    #[test]
    fn the_tightest_control_group_counts() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(control_group(dir.path()), None);
        write(dir.path(), "proc/self/cgroup", "0::/a/b\n");
        write(dir.path(), "sys/fs/cgroup/a/b/memory.max", "max\n");
        assert_eq!(control_group(dir.path()), None);
        write(dir.path(), "sys/fs/cgroup/a/memory.max", "50331648\n");
        let limit = SystemLimit { bytes: 48 << 20, source: "the control group" };
        assert_eq!(control_group(dir.path()), Some(limit));
        write(dir.path(), "proc/self/cgroup", "4:cpu,memory:/c\n3:pids:/\n");
        write(dir.path(), "sys/fs/cgroup/memory/c/memory.limit_in_bytes", "9223372036854771712\n");
        assert_eq!(control_group(dir.path()), None);
        write(dir.path(), "sys/fs/cgroup/memory/c/memory.limit_in_bytes", "50331648\n");
        assert_eq!(control_group(dir.path()), Some(limit));
    }
}
