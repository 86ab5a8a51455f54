//! What the README promises.

use std::path::Path;

use compositor::control::input::{KEYS, MOUSE};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

#[test]
fn the_readme_lists_every_key_as_the_window_obeys_it() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let keys = KEYS.iter().map(|binding| (binding.names(), binding.help));
    let mouse = MOUSE.iter().map(|&(gesture, effect)| (gesture.to_owned(), effect));
    for (key, effect) in keys.chain(mouse) {
        let row = format!("| {key} | {effect} |");
        assert!(readme.contains(&row), "README.md lacks the row\n{row}");
    }
}

#[test]
fn every_file_that_the_documents_name_exists() {
    for document in ["README.md", "ARCHITECTURE.md"] {
        let text = std::fs::read_to_string(root().join(document)).unwrap();
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            assert!(root().join(target).exists(), "{document} links to {target}, which is not there");
        }
        let words = text.split('`').skip(1).step_by(2);
        for path in words.filter(|word| {
            word.starts_with("shared/src/") || word.starts_with("renderer/src/") || word.starts_with("compositor/src/")
        }) {
            assert!(root().join(path).exists(), "{document} names {path}, which is not there");
        }
    }
}
