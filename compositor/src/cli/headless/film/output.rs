//! Where a film's pictures go: to numbered files in a folder, or through ffmpeg into a video.

use std::{
    collections::VecDeque,
    io::{self, Read, Write},
    panic::resume_unwind,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread::JoinHandle,
};

use anyhow::{Context, anyhow, bail};
use channel::files::NewFile;
use renderer::cli::check_writable;
use shared::printable::counted;

use super::picture_file::{self, State};
use crate::gpu::RgbImage;

/// Pictures that are compressed at once: a wall's picture takes about as long to compress as to render.
const N_WRITERS: usize = 2;

/// The receiver of a film's pictures, which come in order.
#[derive(Debug)]
pub enum Output {
    /// None: the film is only measured.
    Nowhere,
    /// A folder of pictures, which may go on where another run ended.
    Pictures(Pictures),
    /// A video.
    Video(Box<Video>),
}

impl Output {
    /// The pictures of `n_pictures` that it takes, by index. Of a film that goes on: the last one that is there, to be
    /// compared, and if the camera rests there, the last one at which it moves; then those that are missing or damaged.
    pub(super) fn pictures_to_render(
        &mut self,
        n_pictures: u32,
        is_moving: impl Fn(u32) -> bool,
    ) -> anyhow::Result<Vec<u32>> {
        match self {
            Self::Pictures(pictures) => pictures.plan(n_pictures, is_moving),
            Self::Nowhere | Self::Video(_) => Ok((0..n_pictures).collect()),
        }
    }

    /// Says what is left of the film when it is cut off, after `n_begun` pictures were handed over.
    pub(super) fn line_if_cut_off(&self, n_pictures: u32) -> Box<dyn Fn(u32) -> String + Send> {
        match self {
            Self::Nowhere => {
                Box::new(move |n_begun| format!("stopped after {n_begun} of {}", counted(n_pictures, "picture")))
            }
            Self::Pictures(Pictures { folder, size, .. }) => {
                let (folder, size) = (folder.clone(), *size);
                Box::new(move |_| written_so_far(&folder, size, n_pictures))
            }
            Self::Video(video) => {
                let path = video.path.clone();
                Box::new(move |n_begun| {
                    format!(
                        "stopped after {n_begun} of {}; {} is not written: a film with --pictures FOLDER can go on \
                         later, with --resume",
                        counted(n_pictures, "picture"),
                        path.display()
                    )
                })
            }
        }
    }

    /// Takes the next picture.
    pub(super) fn put(&mut self, index: u32, image: impl FnOnce() -> anyhow::Result<RgbImage>) -> anyhow::Result<()> {
        match self {
            Self::Nowhere => Ok(()),
            Self::Pictures(pictures) => pictures.put(index, image()?),
            Self::Video(video) => video.put(&image()?),
        }
    }

    /// Waits until everything is written; returns a line about it, for a film of `n_pictures` of the `n_on_path` that the
    /// path has.
    pub(super) fn finish(self, n_pictures: u32, n_on_path: u32) -> anyhow::Result<Option<String>> {
        match self {
            Self::Nowhere => Ok(None),
            Self::Pictures(pictures) => pictures.finish(n_pictures, n_on_path).map(Some),
            Self::Video(video) => video.finish().map(Some),
        }
    }
}

/// A folder of pictures.
#[derive(Debug)]
pub struct Pictures {
    folder: PathBuf,
    fps: f64,
    /// Columns and rows of a picture.
    size: [u32; 2],
    /// The indices of the pictures that are compared with those that are there.
    compared: Vec<u32>,
    writers: VecDeque<JoinHandle<io::Result<()>>>,
}

impl Pictures {
    /// Creates the folder, if there is none, for pictures of `size`: columns, rows. One that holds a film's pictures is
    /// taken only if the film resumes.
    pub fn begin(folder: &Path, fps: f64, size: [u32; 2], resumes: bool) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        if !resumes && holds_pictures(folder, "picture-")? {
            bail!(
                "{} holds pictures of a film: --resume goes on with it, or give --pictures another folder",
                folder.display()
            );
        }
        let file = picture_file(folder, 0);
        check_writable(&file)?;
        let writers = VecDeque::with_capacity(N_WRITERS);
        Ok(Self { folder: folder.to_owned(), fps, size, compared: Vec::new(), writers })
    }

    /// See [`Output::pictures_to_render`].
    fn plan(&mut self, n_pictures: u32, is_moving: impl Fn(u32) -> bool) -> anyhow::Result<Vec<u32>> {
        let file = |index: u32| picture_file(&self.folder, index);
        let states = (0..n_pictures).map(|index| picture_file::state(&file(index), self.size));
        let mut states = states.collect::<io::Result<Vec<_>>>().with_context(|| self.folder.display().to_string())?;
        // Where the camera rests, films of other rates have the same picture.
        for index in (0..n_pictures).rev() {
            let state = &mut states[index as usize];
            if *state != State::Whole || !(self.compared.is_empty() || is_moving(index)) {
                continue;
            }
            // The whole picture is read only where it is to be compared.
            if !picture_file::is_readable(&file(index)) {
                *state = State::Damaged;
                continue;
            }
            tracing::info!("{} is rendered once more, to compare it", file(index).display());
            self.compared.push(index);
            if is_moving(index) {
                break;
            }
        }
        for (index, state) in (0..).zip(&states) {
            match state {
                State::Damaged => tracing::warn!("{} is damaged, and is made again", file(index).display()),
                State::OtherSize => return Err(of_another_film(&file(index))),
                State::Whole | State::Missing => {}
            }
        }
        let missing = (0..).zip(&states).filter(|(_, state)| **state != State::Whole).map(|(index, _)| index);
        Ok(self.compared.iter().copied().chain(missing).collect())
    }

    /// Writes a picture, or compares it with the one that is there: a film never holds pictures of two.
    fn put(&mut self, index: u32, image: RgbImage) -> anyhow::Result<()> {
        let file = picture_file(&self.folder, index);
        if self.compared.contains(&index) {
            return check_same(&file, &image);
        }
        if self.writers.len() == N_WRITERS {
            self.writers.pop_front().map_or(Ok(()), finish)?;
        }
        let write = move || image.write_png(&file);
        let writer = std::thread::Builder::new().name("picture".to_owned()).spawn(write);
        self.writers.push_back(writer.context("cannot start a thread to write a picture")?);
        Ok(())
    }

    fn finish(self, n_pictures: u32, n_on_path: u32) -> anyhow::Result<String> {
        self.writers.into_iter().try_for_each(finish)?;
        let (folder, fps) = (self.folder.display(), self.fps);
        let pictures = match n_on_path {
            _ if n_pictures < n_on_path => format!("the first {n_pictures} of {}", counted(n_on_path, "picture")),
            _ => format!("the film's {}", counted(n_pictures, "picture")),
        };
        let verb = if n_pictures == 1 { "is" } else { "are" };
        Ok(format!("{pictures} {verb} in {folder}: ffmpeg -framerate {fps} -i {folder}/picture-%06d.png film.mp4"))
    }
}

/// Waits until a picture is written.
fn finish(writer: JoinHandle<io::Result<()>>) -> io::Result<()> {
    writer.join().unwrap_or_else(|panic| resume_unwind(panic))
}

fn picture_file(folder: &Path, index: u32) -> PathBuf {
    folder.join(format!("picture-{:06}.png", index + 1))
}

/// Whether a folder holds pictures whose names begin so.
pub(crate) fn holds_pictures(folder: &Path, beginning: &str) -> anyhow::Result<bool> {
    let is_picture = |name: &str| name.starts_with(beginning) && name.ends_with(".png");
    let entries = std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut names = entries.map_while(Result::ok).map(|entry| entry.file_name());
    Ok(names.any(|name| name.to_str().is_some_and(is_picture)))
}

/// The same film gives the same bytes.
fn check_same(file: &Path, image: &RgbImage) -> anyhow::Result<()> {
    let mut expected = Vec::new();
    image.encode(&mut expected)?;
    if std::fs::read(file).with_context(|| file.display().to_string())? != expected {
        return Err(of_another_film(file));
    }
    tracing::info!("going on after {}", file.display());
    Ok(())
}

fn of_another_film(file: &Path) -> anyhow::Error {
    anyhow!(
        "{} is of another film: give the begun film's options to go on with it, or --pictures another folder",
        file.display()
    )
}

/// The line about a film that is cut off.
fn written_so_far(folder: &Path, size: [u32; 2], n_pictures: u32) -> String {
    let is_written =
        |index: &u32| picture_file::state(&picture_file(folder, *index), size).is_ok_and(|state| state == State::Whole);
    let (n_written, pictures) = ((0..n_pictures).filter(is_written).count(), counted(n_pictures, "picture"));
    format!(
        "stopped after {n_written} of {pictures}; those in {} are complete: the same command with --resume goes on",
        folder.display()
    )
}

/// A video that ffmpeg writes.
#[derive(Debug)]
pub struct Video {
    path: PathBuf,
    ffmpeg: Child,
    file: NewFile,
}

impl Video {
    /// Starts ffmpeg for pictures of `size`: columns, rows.
    pub fn begin(path: &Path, fps: f64, size: [u32; 2]) -> anyhow::Result<Self> {
        check_writable(path)?;
        let file = NewFile::begin(path).with_context(|| format!("cannot write --film {}", path.display()))?;
        let [columns, rows] = size;
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-video_size", &format!("{columns}x{rows}"), "-framerate", &fps.to_string(), "-i", "-"]);
        // H.264 has even sides; and players expect the colours of high definition.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv"]);
        command.args([
            "-pix_fmt",
            "yuv420p",
            "-colorspace",
            "bt709",
            "-color_primaries",
            "bt709",
            "-color_trc",
            "bt709",
        ]);
        // The open file, by its descriptor: it has no name yet.
        command.args(["-crf", "16", "-f", "mp4", "-y", "/dev/fd/1"]);
        // Ctrl+C is for this program, whose end is ffmpeg's.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let out = file.file().try_clone().context("cannot hand the film to ffmpeg")?;
        let ffmpeg = command.stdin(Stdio::piped()).stdout(out).stderr(Stdio::piped()).spawn().context(
            "--film needs ffmpeg, which cannot be started: install it (apt, dnf or pacman: ffmpeg), or write pictures with \
             --pictures FOLDER",
        )?;
        Ok(Self { path: path.to_owned(), ffmpeg, file })
    }

    fn put(&mut self, image: &RgbImage) -> anyhow::Result<()> {
        let written = self.ffmpeg.stdin.as_mut().map_or(Ok(()), |stdin| stdin.write_all(&image.rgb));
        match written {
            // It has ended before the film.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => self.wait(),
            written => written.context("cannot send a picture to ffmpeg"),
        }
    }

    fn finish(mut self) -> anyhow::Result<String> {
        self.wait()?;
        let path = self.path.display().to_string();
        self.file.finish().with_context(|| format!("cannot write --film {path}"))?;
        Ok(format!("wrote {path}"))
    }

    /// Waits for ffmpeg's end; its own words explain a failure.
    fn wait(&mut self) -> anyhow::Result<()> {
        drop(self.ffmpeg.stdin.take());
        let mut said = String::new();
        if let Some(mut errors) = self.ffmpeg.stderr.take() {
            errors.read_to_string(&mut said).context("cannot read what ffmpeg says")?;
        }
        let status = self.ffmpeg.wait().context("cannot wait for ffmpeg")?;
        if status.success() {
            return Ok(());
        }
        let said = said.trim();
        bail!(
            "ffmpeg cannot write {} ({status}): {said}; --pictures FOLDER writes pictures instead",
            self.path.display()
        )
    }
}
