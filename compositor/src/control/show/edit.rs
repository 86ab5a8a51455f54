//! Changes of a show's file, whose other words and comments stay as they are.

use std::path::Path;

use channel::files;
use toml_edit::{ArrayOfTables, DocumentMut, Item, Table, value};

use super::file::{LONGEST_FILE, Show, ShowScene};

/// A change of one scene.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum SceneEdit {
    /// Gives it another caption, another time, or both.
    Change {
        caption: Option<String>,
        seconds: Option<f64>,
    },
    /// Puts it in the place of another, by number from 0.
    Move {
        to: usize,
    },
    Delete,
}

/// Where a change leaves the scenes of a show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SceneMap {
    /// Scenes were added at the end, if anything.
    Same,
    Moved {
        from: usize,
        to: usize,
    },
    Deleted(usize),
}

impl SceneMap {
    /// The number that a scene has now; `None` if it is no more.
    pub(crate) fn now(self, index: usize) -> Option<usize> {
        match self {
            Self::Moved { from, to } if index == from => Some(to),
            Self::Moved { from, to } if (from..=to).contains(&index) => Some(index - 1),
            Self::Moved { from, to } if (to..=from).contains(&index) => Some(index + 1),
            Self::Deleted(deleted) if index == deleted => None,
            Self::Deleted(deleted) if index > deleted => Some(index - 1),
            _ => Some(index),
        }
    }
}

/// Changes a scene in a show's file, by its number from 0, if that is still this `scene`. Returns the new show, and where its
/// scenes are now; or the show as others have left it, if that is another scene.
///
/// # Errors
/// One line with the cure; the file stays as it was.
pub(crate) fn edit_scene(
    path: &Path,
    (index, scene): (usize, &ShowScene),
    edit: &SceneEdit,
) -> Result<(Show, Option<SceneMap>), String> {
    let fault = |problem: String| format!("the scene is not changed: {}: {problem}", path.display());
    let text = files::read_text(path, LONGEST_FILE).map_err(|error| fault(error.to_string()))?;
    let before = Show::from_toml(&text, path).map_err(fault)?;
    if before.scenes.get(index) != Some(scene) {
        return Ok((before, None));
    }
    let (text, map) = edited(&text, index, edit).map_err(fault)?;
    let show = Show::from_toml(&text, path).map_err(fault)?;
    files::write(path, |out| out.write_all(text.as_bytes())).map_err(|error| fault(error.to_string()))?;
    Ok((show, Some(map)))
}

/// The text of a show after a change.
fn edited(text: &str, index: usize, edit: &SceneEdit) -> Result<(String, SceneMap), String> {
    let mut document: DocumentMut = text.parse().map_err(|error| format!("{error}").replace('\n', " "))?;
    let scenes = document.get_mut("scene").and_then(Item::as_array_of_tables_mut);
    let scenes = scenes.ok_or("its scenes are no tables [[scene]]: edit it by hand")?;
    let map = match edit {
        SceneEdit::Change { caption, seconds } => {
            let table = scenes.get_mut(index).ok_or("it has no such scene")?;
            if let Some(caption) = caption {
                set(table, "caption", value(caption));
            }
            if let Some(seconds) = seconds {
                set(table, "seconds", value(*seconds));
            }
            SceneMap::Same
        }
        SceneEdit::Move { to } => {
            let mut order: Vec<_> = (0..scenes.len()).collect();
            let to = (*to).min(order.len() - 1);
            let moved = order.remove(index);
            order.insert(to, moved);
            reorder(scenes, &order)?;
            SceneMap::Moved { from: index, to }
        }
        SceneEdit::Delete => {
            let order: Vec<_> = (0..scenes.len()).filter(|&of| of != index).collect();
            reorder(scenes, &order)?;
            SceneMap::Deleted(index)
        }
    };
    Ok((document.to_string(), map))
}

/// Sets a value of a table, and leaves a comment behind the old one.
fn set(table: &mut Table, key: &str, new: Item) {
    let decor = table.get(key).and_then(Item::as_value).map(|value| value.decor().clone());
    table[key] = new;
    if let (Some(decor), Some(value)) = (decor, table[key].as_value_mut()) {
        *value.decor_mut() = decor;
    }
}

/// Puts scenes in another order, or leaves some out. Those that had the model of the scene before them keep it.
fn reorder(scenes: &mut ArrayOfTables, order: &[usize]) -> Result<(), String> {
    let named = |table: &Table| table.get("model").and_then(Item::as_str).map(str::to_owned);
    let mut model = None;
    let models: Vec<Option<String>> = scenes
        .iter()
        .map(|table| {
            model = named(table).or(model.take());
            model.clone()
        })
        .collect();
    let positions: Vec<_> = scenes.iter().map(Table::position).collect();
    let tables: Vec<_> = scenes.iter().cloned().collect();
    scenes.clear();
    let mut model = None;
    for (&index, position) in order.iter().zip(positions) {
        let mut table = tables[index].clone();
        if named(&table).or(model) != models[index] {
            let own =
                models[index].clone().ok_or("a scene of the wall's own model stays before those of other models")?;
            table.insert("model", value(own));
        }
        model = models[index].clone();
        table.set_position(position);
        scenes.push(table);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOUR: &str = "# My tour\nrepeat = false\n\n# The first\n[[scene]]\nmodel = \"a.ply\"\nseconds = 2 # short\ncaption = \"One\"\n\n\
        [[scene]] # of the same\nseconds = 3\ncaption = \"Two\"\n\n[[scene]]\nmodel = \"b.ply\"\nends = \"touch\"\ncaption = \"Three\"\n";

    fn scenes(text: &str) -> Vec<(String, String)> {
        let show = Show::from_toml(text, Path::new("tour.toml")).unwrap();
        let name = |scene: &ShowScene| scene.model.as_ref().map_or(String::new(), |path| path.display().to_string());
        show.scenes.iter().map(|scene| (scene.caption.clone(), name(scene))).collect()
    }

    fn after(edit: &SceneEdit, index: usize) -> (String, Vec<String>) {
        let (text, map) = edited(TOUR, index, edit).unwrap();
        let now = scenes(&text);
        // Every scene is where the map says, with its model.
        for (before, scene) in scenes(TOUR).iter().enumerate() {
            assert_eq!(map.now(before).map(|index| &now[index]), map.now(before).map(|_| scene), "{text}");
        }
        (text, now.into_iter().map(|(caption, _)| caption).collect())
    }

    #[test]
    fn scenes_move_and_go_with_their_models_and_the_rest_stays() {
        let (text, order) = after(&SceneEdit::Move { to: 2 }, 0);
        assert_eq!(order, ["Two", "Three", "One"]);
        assert!(
            text.starts_with("# My tour\nrepeat = false\n")
                && text.contains("# short")
                && text.contains("# of the same")
        );
        assert_eq!(after(&SceneEdit::Move { to: 0 }, 1).1, ["Two", "One", "Three"]);
        assert_eq!(after(&SceneEdit::Move { to: 99 }, 1).1, ["One", "Three", "Two"]);
        assert_eq!(after(&SceneEdit::Move { to: 1 }, 1).0, TOUR);
        for (index, left) in [(0, ["Two", "Three"]), (1, ["One", "Three"]), (2, ["One", "Two"])] {
            assert_eq!(after(&SceneEdit::Delete, index).1, left);
        }
        let empty = edited("[[scene]]\nseconds = 1\n", 0, &SceneEdit::Delete).unwrap().0;
        assert_eq!(scenes(&empty), []);
    }

    #[test]
    fn a_caption_and_a_time_change_in_their_place() {
        let change = SceneEdit::Change { caption: Some("Eins \"hier\"".to_owned()), seconds: Some(4.5) };
        let (text, map) = edited(TOUR, 0, &change).unwrap();
        assert!(text.contains("seconds = 4.5 # short\ncaption = 'Eins") && text.contains("# The first"), "{text}");
        assert_eq!((scenes(&text)[0].0.as_str(), map), ("Eins \"hier\"", SceneMap::Same));
        let (text, _) = edited(TOUR, 2, &SceneEdit::Change { caption: None, seconds: Some(9.0) }).unwrap();
        assert!(text.ends_with("ends = \"touch\"\ncaption = \"Three\"\nseconds = 9.0\n"), "{text}");
    }

    #[test]
    fn a_scene_of_the_wall_s_own_model_keeps_it() {
        let own = "[[scene]]\nseconds = 1\ncaption = \"Own\"\n\n[[scene]]\nmodel = \"a.ply\"\nseconds = 1\n";
        assert!(edited(own, 0, &SceneEdit::Move { to: 1 }).unwrap_err().contains("stays before"));
        assert!(edited("scene = [{ seconds = 1 }]", 0, &SceneEdit::Delete).unwrap_err().contains("by hand"));
    }

    #[test]
    fn a_file_that_was_edited_meanwhile_stays_as_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tour.toml");
        std::fs::write(&path, TOUR).unwrap();
        let show = Show::from_toml(TOUR, &path).unwrap();
        let (show, map) = edit_scene(&path, (1, &show.scenes[1]), &SceneEdit::Delete).unwrap();
        assert_eq!((show.scenes.len(), map.and_then(|map| map.now(2))), (2, Some(1)));
        let kept = std::fs::read_to_string(&path).unwrap();
        let (as_it_is, map) = edit_scene(&path, (0, &show.scenes[1]), &SceneEdit::Delete).unwrap();
        assert_eq!((as_it_is.scenes.len(), map), (2, None));
        let wrong = SceneEdit::Change { caption: None, seconds: Some(0.0) };
        assert!(edit_scene(&path, (0, &show.scenes[0]), &wrong).unwrap_err().contains("from 0.1"));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), kept);
    }
}
