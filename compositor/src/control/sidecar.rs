//! Sidecar files: a model's views, its camera path and its marks, in files beside it.

use std::{
    io,
    path::{Path, PathBuf},
    sync::Arc,
};

use channel::files::{self, ReadError};
use renderer::model::scene::SceneSource;
use shared::{
    camera::{CameraPath, View, Views},
    marks::Marks,
};

use super::marks::KeptMarks;

/// The contents of a model's sidecar files, with the changes since they were read.
#[derive(Clone, Debug)]
pub(crate) struct SidecarFiles {
    /// The model's path, the beginning of each sidecar file's name.
    model_path: PathBuf,
    /// An error if the file exists but cannot be used: it is not overwritten then.
    views: Result<Views, String>,
    path: Result<Option<Arc<CameraPath>>, String>,
    marks: Result<KeptMarks, String>,
}

/// Larger files are not views; bytes.
const LONGEST_VIEWS: u64 = 1 << 20;
/// Enough for the longest camera path; bytes.
const LONGEST_PATH: u64 = 1 << 25;
/// Enough for the most marks; bytes.
const LONGEST_MARKS: u64 = 1 << 22;

impl SidecarFiles {
    /// Reads a model's sidecar files; those of the built-in model lie in the working folder.
    pub(crate) fn read(source: &SceneSource) -> Self {
        let model_path = match source {
            SceneSource::File(path) => path.clone(),
            SceneSource::Statue { .. } => PathBuf::from("statue"),
        };
        let marks_file = marks_file(&model_path);
        let marks = read_marks(&marks_file).map(|(text, marks)| KeptMarks::new(marks_file, text, marks));
        let views_file = with_suffix(&model_path, "views.toml");
        let views = read_optional(&views_file, LONGEST_VIEWS).and_then(|text| {
            text.map_or(Ok(Views::default()), |text| {
                Views::from_toml(&text).map_err(|error| format!("{}: {error}", views_file.display()))
            })
        });
        let path_file = with_suffix(&model_path, "path.toml");
        let path = read_optional(&path_file, LONGEST_PATH)
            .and_then(|text| text.map(|text| parse_path(&path_file, &text)).transpose());
        Self { model_path, views, path: path.map(|path| path.map(Arc::new)), marks }
    }

    pub(crate) fn views(&self) -> Option<&Views> {
        self.views.as_ref().ok()
    }

    /// The camera path, if there is one that could be read.
    pub(crate) fn path(&self) -> Option<Arc<CameraPath>> {
        self.path.as_ref().ok().cloned().flatten()
    }

    /// Why a file could not be read.
    pub(crate) fn problem(&self) -> Option<&str> {
        let problems = [self.views.as_ref().err(), self.path.as_ref().err(), self.marks.as_ref().err()];
        problems.into_iter().flatten().next().map(String::as_str)
    }

    /// The marks, unless their file could not be read.
    pub(crate) fn marks(&self) -> Option<&KeptMarks> {
        self.marks.as_ref().ok()
    }

    /// The marks, to change them.
    ///
    /// # Errors
    /// Their file could not be read: it must not be overwritten.
    pub(crate) fn marks_mut(&mut self) -> Result<&mut KeptMarks, String> {
        self.marks.as_mut().map_err(|problem| format!("marks are not kept: {problem}"))
    }

    /// Keeps a view under a number. Returns the file and its new text for [`write_views`], which the caller runs on a
    /// thread that may wait for a disk.
    pub(crate) fn keep_view(&mut self, number: u8, view: View) -> Result<(PathBuf, String), String> {
        let views = self.views.as_mut().map_err(|problem| format!("the view is not kept: {problem}"))?;
        views.keep(number, view);
        views.up = view.up.or(views.up);
        Ok((with_suffix(&self.model_path, "views.toml"), views.to_toml()))
    }

    /// Replaces the camera path. Returns its file for [`write_path`].
    pub(crate) fn keep_path(&mut self, path: Arc<CameraPath>) -> PathBuf {
        self.path = Ok(Some(path));
        with_suffix(&self.model_path, "path.toml")
    }
}

/// Reads a camera path, for the option `--path`.
pub(crate) fn read_path(file: &Path) -> Result<CameraPath, String> {
    let text = read_optional(file, LONGEST_PATH)?;
    let text = text.ok_or_else(|| {
        format!(
            "{}: there is no such file: record a path with C on the wall, which writes it beside the model",
            file.display()
        )
    })?;
    parse_path(file, &text)
}

/// The file of a model's marks.
pub(crate) fn marks_file(model: &Path) -> PathBuf {
    with_suffix(model, "marks.toml")
}

/// Reads a file of marks; also returns its text, `None` if there is no file yet.
pub(crate) fn read_marks(file: &Path) -> Result<(Option<String>, Marks), String> {
    let text = read_optional(file, LONGEST_MARKS)?;
    let marks = text.as_deref().map(Marks::from_toml).transpose();
    marks.map(|marks| (text, marks.unwrap_or_default())).map_err(|error| format!("{}: {error}", file.display()))
}

/// Writes a file of a model's marks, whose text was `before` when it was read or written last. Another text, which somebody
/// else has written, is copied to a numbered file. Returns that file.
pub(crate) fn write_beside(file: &Path, before: Option<&str>, text: &str) -> Result<Option<PathBuf>, String> {
    let fault = |error: &dyn std::fmt::Display| format!("{} cannot be written: {error}", file.display());
    let is_known = read_optional(file, LONGEST_MARKS).is_ok_and(|found| found.as_deref() == before);
    let numbered = |number| {
        let ending = file.extension().unwrap_or_default().to_string_lossy();
        file.with_extension(format!("{number:04}.{ending}"))
    };
    let copy = if is_known { None } else { files::copy_numbered(file, numbered).map_err(|error| fault(&error))? };
    files::write(file, |out| out.write_all(text.as_bytes())).map_err(|error| fault(&error))?;
    Ok(copy)
}

/// Writes measurements as a table.
pub(crate) fn write_table(file: &Path, text: &str) -> Result<(), String> {
    files::write(file, |out| out.write_all(text.as_bytes()))
        .map_err(|error| format!("{} cannot be written: {error}", file.display()))
}

pub(crate) fn write_views(file: &Path, text: &str) -> Result<(), String> {
    files::write(file, |out| out.write_all(text.as_bytes())).map_err(|error| {
        format!("the view is kept until the wall ends, but {} cannot be written: {error}", file.display())
    })
}

/// Writes a camera path; copies an existing file to a numbered one, so that no recording is lost.
pub(crate) fn write_path(file: &Path, path: &CameraPath) -> Result<(), String> {
    let written = files::copy_numbered(file, |number| file.with_extension(format!("{number:04}.toml")))
        .and_then(|_| files::write(file, |out| out.write_all(path.to_toml().as_bytes())));
    written.map_err(|error| {
        format!("the camera path is kept until the wall ends, but {} cannot be written: {error}", file.display())
    })
}

fn parse_path(file: &Path, text: &str) -> Result<CameraPath, String> {
    CameraPath::from_toml(text).map_err(|error| format!("{}: {error}", file.display()))
}

/// `dragon.ply` becomes `dragon.ply.views.toml`, so that models of the same stem have separate files.
pub(crate) fn with_suffix(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    PathBuf::from(name)
}

/// The text of a file; `None` if it does not exist.
fn read_optional(path: &Path, longest: u64) -> Result<Option<String>, String> {
    match files::read_text(path, longest) {
        Ok(text) => Ok(Some(text)),
        Err(ReadError::Io(error)) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(format!("{}: {error}", path.display())),
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        camera::{Camera, Look, UpAxis},
        marks::Annotation,
    };

    use super::*;
    use crate::control::marks::FileToWrite;

    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let folder = std::env::temp_dir().join(format!("raywall-kept-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&folder).unwrap();
            Self(folder)
        }

        fn model(&self) -> SceneSource {
            SceneSource::File(self.0.join("a model.ply"))
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
        let front = Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Z, 0.7, 1.5).unwrap();
        front.orbit(DVec3::ZERO, UpAxis::Z, yaw, 0.0)
    }

    fn view(yaw: f64) -> View {
        View { camera: camera(yaw), up: Some(UpAxis::Z), look: Some(Look::default()) }
    }

    #[test]
    fn views_come_back_with_their_model() {
        let folder = Folder::new("views");
        let mut sidecars = SidecarFiles::read(&folder.model());
        assert!(sidecars.problem().is_none() && sidecars.views().unwrap().numbers().next().is_none());
        for (number, yaw) in [(3, 0.1), (9, 0.2), (3, 0.3)] {
            let (file, text) = sidecars.keep_view(number, view(yaw)).unwrap();
            write_views(&file, &text).unwrap();
        }
        assert_eq!(folder.files(), ["a model.ply.views.toml"]);
        let again = SidecarFiles::read(&folder.model());
        assert_eq!(again.views(), sidecars.views());
        assert_eq!((again.views().unwrap().get(3), again.views().unwrap().up), (Some(view(0.3)), Some(UpAxis::Z)));
    }

    #[test]
    fn a_broken_file_is_reported_and_not_overwritten() {
        let folder = Folder::new("broken");
        std::fs::write(folder.0.join("a model.ply.views.toml"), "up = y").unwrap();
        let mut sidecars = SidecarFiles::read(&folder.model());
        assert!(sidecars.problem().unwrap().contains("a model.ply.views.toml: line 1:"), "{:?}", sidecars.problem());
        let refused = sidecars.keep_view(1, view(0.0)).unwrap_err();
        assert!(refused.contains("line 1"), "{refused}");
        std::fs::write(folder.0.join("a model.ply.views.toml"), vec![b' '; 2 << 20]).unwrap();
        assert!(SidecarFiles::read(&folder.model()).problem().unwrap().contains("longer than"));
        std::fs::remove_file(folder.0.join("a model.ply.views.toml")).unwrap();
        std::fs::write(folder.0.join("a model.ply.marks.toml"), "[[annotation]]").unwrap();
        let mut sidecars = SidecarFiles::read(&folder.model());
        assert!(sidecars.problem().unwrap().contains("a model.ply.marks.toml: line 1:") && sidecars.marks().is_none());
        assert!(sidecars.marks_mut().unwrap_err().starts_with("marks are not kept: "));
        std::fs::remove_file(folder.0.join("a model.ply.marks.toml")).unwrap();
        std::fs::create_dir(folder.0.join("a model.ply.path.toml")).unwrap();
        let problem = SidecarFiles::read(&folder.model()).problem().unwrap().to_owned();
        assert!(problem.ends_with("path.toml: is a folder or a pipe: name an ordinary file"), "{problem}");
    }

    fn annotation(label: &str) -> Annotation {
        Annotation::new(label, "long", DVec3::ONE, Some(DVec3::Y), Some(view(0.5))).unwrap()
    }

    #[test]
    fn marks_come_back_with_their_model_and_what_others_have_written_is_kept() {
        let folder = Folder::new("marks");
        let mut sidecars = SidecarFiles::read(&folder.model());
        let keep = |sidecars: &mut SidecarFiles, label| {
            let marks = sidecars.marks_mut().unwrap();
            let FileToWrite { file, before, text } = marks.keep_annotation(None, annotation(label)).unwrap().1;
            write_beside(&file, before.as_deref(), &text).unwrap()
        };
        assert_eq!([keep(&mut sidecars, "a"), keep(&mut sidecars, "b")], [None, None]);
        assert_eq!(folder.files(), ["a model.ply.marks.toml"]);
        let mut again = SidecarFiles::read(&folder.model());
        assert_eq!(again.marks().unwrap().annotation(2), Some(&annotation("b")));
        let foreign = "# by another program\n";
        std::fs::write(folder.0.join("a model.ply.marks.toml"), foreign).unwrap();
        let copy = keep(&mut again, "c").unwrap();
        assert_eq!(copy, folder.0.join("a model.ply.marks.0001.toml"));
        assert_eq!(std::fs::read_to_string(copy).unwrap(), foreign);
        assert_eq!(SidecarFiles::read(&folder.model()).marks().unwrap().annotations().count(), 3);
    }

    #[test]
    fn no_recorded_path_is_lost() {
        let folder = Folder::new("paths");
        let path = |yaw| Arc::new(CameraPath::new(vec![(0.0, camera(0.0)), (1.0, camera(yaw))], UpAxis::Z).unwrap());
        let mut sidecars = SidecarFiles::read(&folder.model());
        assert!(sidecars.path().is_none());
        for yaw in [1.0, 2.0, 3.0] {
            let file = sidecars.keep_path(path(yaw));
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
