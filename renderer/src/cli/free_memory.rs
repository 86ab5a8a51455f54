//! The memory and disk that this machine can give a program, as the system tells it.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::OnceLock,
};

/// Bytes that a program can have; `None` where the system does not tell, or sets no limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FreeMemory {
    /// Without swapping, together with all programs that start with it.
    pub shared: Option<u64>,
    /// For this program alone.
    pub own: Option<u64>,
}

impl FreeMemory {
    /// The memory that was free when this was first asked: before a program loads its first scene, which would count as taken.
    pub fn at_start() -> Self {
        static AT_START: OnceLock<FreeMemory> = OnceLock::new();
        *AT_START.get_or_init(Self::now)
    }

    /// The memory that is free now: of the machine, of the control groups that this process is in, and of its own addresses.
    pub fn now() -> Self {
        let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
        let of_groups = group_folders(&groups).into_iter().filter_map(|(folder, files)| {
            let text = |name: &str| fs::read_to_string(folder.join(name)).ok();
            left_in_group(
                &text(files.limit)?,
                &text(files.usage)?,
                &text("memory.stat").unwrap_or_default(),
                files.cache,
            )
        });
        let shared = available_bytes().into_iter().chain(of_groups).min();
        Self { shared, own: addresses_left() }
    }
}

/// Bytes that programs can have without swapping.
pub(super) fn available_bytes() -> Option<u64> {
    let counts = fs::read_to_string("/proc/meminfo").ok()?;
    let kilobytes = counts.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?.trim().strip_suffix(" kB")?;
    kilobytes.parse::<u64>().ok()?.checked_mul(1024)
}

/// Bytes that this user may still write to the disk of a folder, if the system tells.
pub fn free_disk(folder: &Path) -> Option<u64> {
    #[cfg(unix)]
    return rustix::fs::statvfs(folder).ok().map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    #[cfg(not(unix))]
    {
        let _ = folder;
        None
    }
}

/// Names of a control group's files, and the line of its `memory.stat` with the cache that can be dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct GroupFiles {
    limit: &'static str,
    usage: &'static str,
    cache: &'static str,
}

const VERSION_1: GroupFiles =
    GroupFiles { limit: "memory.limit_in_bytes", usage: "memory.usage_in_bytes", cache: "total_inactive_file" };
const VERSION_2: GroupFiles = GroupFiles { limit: "memory.max", usage: "memory.current", cache: "inactive_file" };

/// The folders of a process's groups and of those above them, by its `/proc/self/cgroup`. In a container, a group's own
/// folder is often the root.
fn group_folders(groups: &str) -> Vec<(PathBuf, GroupFiles)> {
    let of_line = |line: &str| {
        let (_, rest) = line.split_once(':')?;
        let (controllers, path) = rest.split_once(':')?;
        let (root, files) = match controllers {
            "" => ("/sys/fs/cgroup", VERSION_2),
            _ if controllers.split(',').any(|it| it == "memory") => ("/sys/fs/cgroup/memory", VERSION_1),
            _ => return None,
        };
        let way = Path::new(path.trim_start_matches('/'));
        Some(way.ancestors().map(move |way| (Path::new(root).join(way), files)).collect::<Vec<_>>())
    };
    groups.lines().filter_map(of_line).flatten().collect()
}

/// Bytes that a group may still take, by the texts of its files; `None` without a limit.
fn left_in_group(limit: &str, usage: &str, stat: &str, cache: &str) -> Option<u64> {
    let limit = limit.trim().parse::<u64>().ok()?;
    let cache = stat.lines().find_map(|line| line.strip_prefix(cache)?.strip_prefix(' ')?.trim().parse::<u64>().ok());
    let taken = usage.trim().parse::<u64>().ok()?.saturating_sub(cache.unwrap_or(0));
    Some(limit.saturating_sub(taken))
}

/// Bytes that this process may still map, if `ulimit -v` limits them.
pub(super) fn addresses_left() -> Option<u64> {
    let limits = fs::read_to_string("/proc/self/limits").ok()?;
    let limit = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    let limit = limit.split_whitespace().next()?.parse::<u64>().ok()?;
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let mapped = status.lines().find_map(|line| line.strip_prefix("VmSize:"))?.trim().strip_suffix(" kB")?;
    Some(limit.saturating_sub(mapped.parse::<u64>().ok()?.saturating_mul(1024)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn the_free_disk_is_known() {
        let folder = tempfile::tempdir().unwrap();
        assert!(free_disk(folder.path()).unwrap() > 0);
        assert_eq!(free_disk(&folder.path().join("nowhere")), None);
    }

    #[test]
    fn the_groups_of_a_process_and_those_above_count() {
        let folders = |groups: &str| {
            let folders = group_folders(groups).into_iter();
            folders.map(|(folder, files)| (folder.to_str().unwrap().to_owned(), files)).collect::<Vec<_>>()
        };
        let [root, inner, leaf] = ["", "a.slice", "a.slice/b"].map(|way| format!("/sys/fs/cgroup/{way}"));
        assert_eq!(folders("0::/a.slice/b\n"), [(leaf, VERSION_2), (inner, VERSION_2), (root, VERSION_2)]);
        let first = "9:name=systemd:/x\n4:cpu,memory:/a\n2:cpuset:/memory\n";
        let [root, leaf] = ["", "a"].map(|way| format!("/sys/fs/cgroup/memory/{way}"));
        assert_eq!(folders(first), [(leaf, VERSION_1), (root, VERSION_1)]);
        assert_eq!(folders("nonsense\n1:2\n"), []);
    }

    #[test]
    fn a_group_has_its_limit_less_what_cannot_be_dropped() {
        let stat = "anon 100\ninactive_file 300\ntotal_inactive_file 50\n";
        assert_eq!(left_in_group("1000\n", "600\n", stat, "inactive_file"), Some(700));
        assert_eq!(left_in_group("1000\n", "600\n", stat, "total_inactive_file"), Some(450));
        assert_eq!(left_in_group("1000\n", "600\n", "", "inactive_file"), Some(400));
        assert_eq!(left_in_group("100\n", "600\n", "", "inactive_file"), Some(0));
        assert_eq!(left_in_group("max\n", "600\n", stat, "inactive_file"), None);
        assert_eq!(left_in_group("1000\n", "", stat, "inactive_file"), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_system_tells_the_free_memory() {
        assert!(available_bytes().unwrap() > 1_000_000);
        let FreeMemory { shared, .. } = FreeMemory::now();
        assert!(shared.unwrap() > 1_000_000 && shared <= available_bytes().map(|bytes| bytes + (1 << 30)));
    }
}
