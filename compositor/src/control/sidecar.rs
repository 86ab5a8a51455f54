//! What is kept in files beside a model: its views and its camera path.

use std::{
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
    sync::Arc,
};

use renderer::{model::scene::SceneSource, render::image::write_atomically};
use shared::camera::{Camera, CameraPath, UpAxis, Views};

/// What is kept beside a model, as it was read with it and changed since.
#[derive(Clone, Debug)]
pub struct SidecarFiles {
    /// The model's own path, to which endings are added.
    model_path: PathBuf,
    /// Why not, where the file is there and cannot be used: then it is not written over.
    views: Result<Views, String>,
    path: Result<Option<Arc<CameraPath>>, String>,
}

/// Larger files of views are none.
const LONGEST_VIEWS: u64 = 1 << 20;
/// Room for the longest camera path.
const LONGEST_PATH: u64 = 1 << 25;
/// More former camera paths than this beside one model are surely a mistake.
const MOST_FORMER_PATHS: u32 = 9999;

impl SidecarFiles {
    /// Reads what is kept beside a model; beside the built-in one, that is in the working folder.
    pub fn read(source: &SceneSource) -> Self {
        let model_path = match source {
            SceneSource::Ply(path) => path.clone(),
            SceneSource::Statue { .. } => PathBuf::from("statue"),
        };
        let views_file = with_suffix(&model_path, "views.toml");
        let views = read_optional(&views_file, LONGEST_VIEWS).and_then(|text| {
            text.map_or(Ok(Views::default()), |text| {
                Views::from_toml(&text).map_err(|error| format!("{}: {error}", views_file.display()))
            })
        });
        let path_file = with_suffix(&model_path, "path.toml");
        let path = read_optional(&path_file, LONGEST_PATH)
            .and_then(|text| text.map(|text| parse_path(&path_file, &text)).transpose());
        Self { model_path, views, path: path.map(|path| path.map(Arc::new)) }
    }

    /// The views, if they could be read.
    pub fn views(&self) -> Option<&Views> {
        self.views.as_ref().ok()
    }

    /// The camera path, if there is one that could be read.
    pub fn path(&self) -> Option<Arc<CameraPath>> {
        self.path.as_ref().ok().cloned().flatten()
    }

    /// What an operator should know of files that could not be read.
    pub fn problem(&self) -> Option<&str> {
        self.views.as_ref().err().or(self.path.as_ref().err()).map(String::as_str)
    }

    /// Gives a view a number, and says which file is to hold what then; not on this thread, for a disk may be slow.
    pub fn keep_view(&mut self, number: u8, camera: Camera, up: UpAxis) -> Result<(PathBuf, String), String> {
        let views = self.views.as_mut().map_err(|problem| format!("no view is kept: {problem}"))?;
        views.keep(number, camera);
        views.up = Some(up);
        Ok((with_suffix(&self.model_path, "views.toml"), views.to_toml()))
    }

    /// Takes another camera path, and says in which file it is to be kept by [`write_path`].
    pub fn keep_path(&mut self, path: Arc<CameraPath>) -> PathBuf {
        self.path = Ok(Some(path));
        with_suffix(&self.model_path, "path.toml")
    }
}

/// Reads a camera path for `--path`.
pub fn read_path(file: &Path) -> Result<CameraPath, String> {
    let text = read_optional(file, LONGEST_PATH)?;
    let text = text.ok_or_else(|| {
        format!(
            "{}: there is no such file: record a path with C on the wall, and it is beside the model",
            file.display()
        )
    })?;
    parse_path(file, &text)
}

/// Writes the views beside a model.
pub fn write_views(file: &Path, text: &str) -> Result<(), String> {
    write_atomically(file, |out| out.write_all(text.as_bytes())).map_err(|error| {
        format!("the view is kept until the wall ends, but {} cannot be written: {error}", file.display())
    })
}

/// Writes a camera path; a file that is there already is renamed, and nothing that was recorded is lost.
pub fn write_path(file: &Path, path: &CameraPath) -> Result<(), String> {
    let written =
        rename_existing(file).and_then(|()| write_atomically(file, |out| out.write_all(path.to_toml().as_bytes())));
    written.map_err(|error| {
        format!("the camera path is kept until the wall ends, but {} cannot be written: {error}", file.display())
    })
}

fn rename_existing(file: &Path) -> io::Result<()> {
    if !file.try_exists()? {
        return Ok(());
    }
    for number in 1..=MOST_FORMER_PATHS {
        let former = file.with_extension(format!("{number:04}.toml"));
        match File::create_new(&former) {
            Ok(_) => return std::fs::rename(file, former),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::other(format!("there are {MOST_FORMER_PATHS} former paths already: move some away")))
}

fn parse_path(file: &Path, text: &str) -> Result<CameraPath, String> {
    CameraPath::from_toml(text).map_err(|error| format!("{}: {error}", file.display()))
}

/// `dragon.ply` becomes `dragon.ply.views.toml`: two models that differ in their endings share nothing.
fn with_suffix(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    PathBuf::from(name)
}

/// A file's text; `None` if there is no such file.
fn read_optional(path: &Path, longest: u64) -> Result<Option<String>, String> {
    let cannot = |error: &dyn std::fmt::Display| format!("{}: cannot be read: {error}", path.display());
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(cannot(&error)),
    };
    let mut text = String::new();
    let n_bytes = file.take(longest + 1).read_to_string(&mut text).map_err(|error| cannot(&error))?;
    if n_bytes as u64 > longest {
        return Err(cannot(&format_args!("it is longer than {longest} bytes")));
    }
    Ok(Some(text))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let folder = std::env::temp_dir().join(format!("raywall-kept-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&folder).unwrap();
            Self(folder)
        }

        fn model(&self) -> SceneSource {
            SceneSource::Ply(self.0.join("a model.ply"))
        }

        fn files(&self) -> Vec<String> {
            let entries = std::fs::read_dir(&self.0).unwrap();
            let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    fn camera(yaw: f64) -> Camera {
        let front = Camera::view_all(DVec3::ZERO, DVec3::ONE, UpAxis::Z, 1.5);
        front.orbit(DVec3::ZERO, UpAxis::Z, yaw, 0.0)
    }

    #[test]
    fn views_come_back_with_their_model() {
        let folder = Folder::new("views");
        let mut kept = SidecarFiles::read(&folder.model());
        assert!(kept.problem().is_none() && kept.views().unwrap().numbers().next().is_none());
        for (number, yaw) in [(3, 0.1), (9, 0.2), (3, 0.3)] {
            let (file, text) = kept.keep_view(number, camera(yaw), UpAxis::Z).unwrap();
            write_views(&file, &text).unwrap();
        }
        assert_eq!(folder.files(), ["a model.ply.views.toml"]);
        let again = SidecarFiles::read(&folder.model());
        assert_eq!(again.views(), kept.views());
        assert_eq!((again.views().unwrap().get(3), again.views().unwrap().up), (Some(camera(0.3)), Some(UpAxis::Z)));
    }

    #[test]
    fn a_file_that_somebody_broke_is_told_and_not_written_over() {
        let folder = Folder::new("broken");
        std::fs::write(folder.0.join("a model.ply.views.toml"), "up = y").unwrap();
        let mut kept = SidecarFiles::read(&folder.model());
        assert!(kept.problem().unwrap().contains("a model.ply.views.toml: line 1:"), "{:?}", kept.problem());
        let refused = kept.keep_view(1, camera(0.0), UpAxis::Y).unwrap_err();
        assert!(refused.contains("line 1"), "{refused}");
        std::fs::write(folder.0.join("a model.ply.views.toml"), vec![b' '; 2 << 20]).unwrap();
        assert!(SidecarFiles::read(&folder.model()).problem().unwrap().contains("longer than"));
    }

    #[test]
    fn no_path_that_was_recorded_is_lost() {
        let folder = Folder::new("paths");
        let path = |yaw| Arc::new(CameraPath::new(vec![(0.0, camera(0.0)), (1.0, camera(yaw))], UpAxis::Z).unwrap());
        let mut kept = SidecarFiles::read(&folder.model());
        assert!(kept.path().is_none());
        for yaw in [1.0, 2.0, 3.0] {
            let file = kept.keep_path(path(yaw));
            write_path(&file, &path(yaw)).unwrap();
        }
        assert_eq!(
            folder.files(),
            ["a model.ply.path.0001.toml", "a model.ply.path.0002.toml", "a model.ply.path.toml"]
        );
        assert_eq!(SidecarFiles::read(&folder.model()).path(), Some(path(3.0)));
        assert_eq!(read_path(&folder.0.join("a model.ply.path.0001.toml")), Ok((*path(1.0)).clone()));
        assert!(read_path(&folder.0.join("no.toml")).unwrap_err().contains("record a path with C"));
        assert!(write_path(Path::new("/no/such/folder/p.toml"), &path(1.0)).unwrap_err().contains("cannot be written"));
    }
}
