//! The documents: keys, paths and links.

use std::path::{Path, PathBuf};

use compositor::control::input::{KEYS, MOUSE};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

#[test]
fn the_manual_lists_every_key_of_the_window() {
    let manual = std::fs::read_to_string(root().join("wall-config/README.md")).unwrap();
    let keys = KEYS.iter().map(|binding| (binding.names(), binding.help));
    let mouse = MOUSE.iter().map(|&(gesture, effect)| (gesture.to_owned(), effect));
    for (key, effect) in keys.chain(mouse) {
        let row = format!("| {key} | {effect} |");
        assert!(manual.contains(&row), "wall-config/README.md lacks the row\n{row}");
    }
}

/// Folders to which the documents' paths may be relative.
const ROOMS: [&str; 5] = ["shared/src", "shared/channel/src", "renderer/src", "compositor/src", "tests"];

/// The anchor of a Markdown heading: lower case, hyphens for spaces, no punctuation.
fn anchor(heading: &str) -> String {
    let title = heading.trim_start_matches('#').trim().to_lowercase();
    title.chars().filter(|c| c.is_alphanumeric() || " -".contains(*c)).map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn every_file_that_the_documents_name_exists() {
    for document in ["README.md", "ARCHITECTURE.md", "wall-config/README.md", "tests/README.md"] {
        let path = root().join(document);
        let text = std::fs::read_to_string(&path).unwrap();
        let folder = path.parent().unwrap();
        let targets = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        for target in targets.filter(|target| !target.starts_with("https://")) {
            let (file, heading) = target.split_once('#').unwrap_or((target, ""));
            let linked = if file.is_empty() { path.clone() } else { folder.join(file) };
            assert!(linked.exists(), "{document} links to {target}, which is not there");
            if !heading.is_empty() {
                let linked_text = std::fs::read_to_string(&linked).unwrap();
                let has_heading = linked_text.lines().any(|line| line.starts_with('#') && anchor(line) == heading);
                assert!(has_heading, "{document} links to {target}, but there is no such heading");
            }
        }
        for word in text.split('`').skip(1).step_by(2).filter(|word| !word.contains(' ')) {
            let is_file = [".rs", ".wgsl"].iter().any(|extension| word.ends_with(extension));
            if is_file || ROOMS.iter().any(|room| word.starts_with(&format!("{room}/"))) {
                let exists =
                    root().join(word).exists() || ROOMS.iter().any(|room| root().join(room).join(word).exists());
                assert!(exists, "{document} names {word}, which is not there");
            }
        }
    }
}

/// On a machine with apt, and without anything that the wall needs.
#[cfg(unix)]
#[test]
fn the_set_up_says_what_apt_may_do_and_asks_first() {
    use std::{
        os::unix::fs::PermissionsExt,
        process::{Command, Stdio},
    };
    let folder = tempfile::tempdir().unwrap();
    for name in ["apt-get", "cargo"] {
        let program = folder.path().join(name);
        std::fs::write(&program, format!("#!/bin/sh\necho {name} was started\n")).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    let mut command = Command::new("/bin/sh");
    command.arg(root().join("tests/setup.sh")).arg("run").env("PATH", folder.path()).env_remove("YES").env_remove("CI");
    let output = command.stdin(Stdio::null()).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(1), "nobody has agreed\n{said}");
    assert!(said.contains("To install them: sudo apt-get install") && said.contains("Install now?"), "{said}");
    assert!(!said.contains("was started"), "{said}");
    let warning = "apt may upgrade packages that these depend on";
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    assert!(said.contains(warning) && readme.contains(warning), "{said}");
}

/// The part of every source file that is not a test.
fn sources(folder: &Path, found: &mut Vec<(PathBuf, String)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            let text = std::fs::read_to_string(&path).unwrap();
            let end = text.find("#[cfg(test)]\nmod ").unwrap_or(text.len());
            found.push((path, text[..end].to_owned()));
        }
    }
}

#[test]
fn one_place_writes_files() {
    let mut found = Vec::new();
    for room in ["shared/src", "shared/channel/src", "renderer/src", "compositor/src", "tests/lab/src"] {
        sources(&root().join(room), &mut found);
    }
    for (path, text) in found.iter().filter(|(path, _)| !path.ends_with("channel/src/files.rs")) {
        for call in ["File::create", "fs::write(", "fs::rename(", "fs::copy(", "OpenOptions", "File::options"] {
            assert!(!text.contains(call), "{} calls {call}: channel::files writes files", path.display());
        }
    }
    assert!(found.len() > 100, "{}", found.len());
}
