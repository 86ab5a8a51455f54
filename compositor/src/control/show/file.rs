//! The file of a show: TOML with a table for each scene.

use std::{
    fmt::{Display, Write},
    mem,
    path::{Path, PathBuf},
    str::FromStr,
    time::Duration,
};

use channel::files;
use glam::DVec3;
use serde::{Deserialize, Deserializer, de::Error};
use shared::{
    appearance::{Clip, Light},
    camera::{Camera, UpAxis},
    path_light::PathLight,
    printable::printable_line,
    protocol::LightingMode,
    toml_text::plain_problem,
};
use toml::Spanned;

/// Longer files are no shows; bytes.
pub(super) const LONGEST_FILE: u64 = 1 << 20;
/// The most scenes of a show.
const MOST_SCENES: usize = 1000;
/// The longest caption in characters: about three lines on the wall.
pub(crate) const MOST_CAPTION: usize = 200;
/// The longest time of a scene, and the longest fade, in seconds.
const MOST_SECONDS: f64 = 86_400.0;
const MOST_FADE: f64 = 10.0;

/// Scenes, and how one changes into the next.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Show {
    /// The time of each change.
    pub fade: Duration,
    /// Whether the first scene follows the last.
    pub repeats: bool,
    pub scenes: Vec<ShowScene>,
}

/// A scene of a show.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ShowScene {
    /// The model's file; `None` for the model that the wall was started with.
    pub model: Option<PathBuf>,
    pub place: Place,
    /// The axis that points up; `None` leaves it to the view or the model.
    pub up: Option<UpAxis>,
    pub light: Option<Light>,
    pub clip: Option<Clip>,
    pub rays: Option<LightingMode>,
    pub path_light: Option<PathLight>,
    /// The text under it; empty for none.
    pub caption: String,
    pub ending: Ending,
}

/// Where the eye is.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Place {
    /// The whole model.
    Whole,
    /// A view that is kept beside the model.
    View(u8),
    /// A camera path, from a file.
    Path(PathBuf),
    Camera(Camera),
}

/// The end of a scene; the order to go on ends every scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ending {
    /// After this time; `None` for the time of the camera path, if it has one.
    pub after: Option<Duration>,
    /// By a touch too.
    pub by_touch: bool,
    /// Not by time, not even that of its camera path.
    pub waits: bool,
}

impl Show {
    /// The show where nobody is: it is played once, and scenes that wait for a touch or an order end with their path, or as soon
    /// as they were shown.
    pub(crate) fn unattended(mut self) -> Self {
        self.repeats = false;
        for scene in &mut self.scenes {
            if mem::take(&mut scene.ending.waits) && !matches!(scene.place, Place::Path(_)) {
                scene.ending.after = Some(Duration::ZERO);
            }
        }
        self
    }
}

/// Reads a show. The error is one line with the cure.
pub(crate) fn read(path: &Path) -> Result<Show, String> {
    let text = files::read_text(path, LONGEST_FILE)
        .map_err(|error| format!("{}: {error}; an empty file begins a new show", path.display()))?;
    Show::from_toml(&text, path).map_err(|problem| format!("{}: {problem}", path.display()))
}

/// Adds a scene to the end of a show's file, whose own words stay as they are. Returns the new show.
pub(crate) fn add_scene(path: &Path, scene: &ShowScene) -> Result<Show, String> {
    let fault = |problem: String| format!("the scene is not kept: {}: {problem}", path.display());
    let text = files::read_text(path, LONGEST_FILE).map_err(|error| fault(error.to_string()))?;
    Show::from_toml(&text, path).map_err(fault)?;
    let gap = if text.is_empty() {
        ""
    } else if text.ends_with('\n') {
        "\n"
    } else {
        "\n\n"
    };
    let text = format!("{text}{gap}{}", scene.to_toml(path));
    let show = Show::from_toml(&text, path).map_err(fault)?;
    files::write(path, |out| out.write_all(text.as_bytes())).map_err(|error| fault(error.to_string()))?;
    Ok(show)
}

impl Show {
    /// Reads the text of a show's file; names of files in it are relative to `path`.
    ///
    /// # Errors
    /// The line, the fault and the format.
    pub(crate) fn from_toml(text: &str, path: &Path) -> Result<Self, String> {
        let at = |offset: usize, problem: &str| {
            let line = 1 + text.get(..offset).unwrap_or("").matches('\n').count();
            format!("line {line}: {}", plain_problem(text, offset, problem))
        };
        let file: ShowFile = toml::from_str(text).map_err(|error| {
            let offset = error.span().map_or(0, |span| span.start);
            format!("{}; {FORMAT}", at(offset, error.message()))
        })?;
        if !(0.0..=MOST_FADE).contains(&file.fade_seconds) {
            return Err(at(0, &format!("fade_seconds is from 0 to {MOST_FADE}")));
        }
        if file.scene.len() > MOST_SCENES {
            return Err(at(0, &format!("a show has at most {MOST_SCENES} scenes")));
        }
        let mut scenes: Vec<ShowScene> = Vec::with_capacity(file.scene.len());
        for table in file.scene {
            let start = table.span().start;
            let scene = table.into_inner().scene(path, scenes.last()).map_err(|problem| at(start, &problem))?;
            scenes.push(scene);
        }
        Ok(Self { fade: Duration::from_secs_f64(file.fade_seconds), repeats: file.repeat, scenes })
    }
}

const FORMAT: &str = "a show has fade_seconds and repeat, and tables [[scene]] with model, one of view, path, or eye, ll, u and \
    v, perhaps up, light, clip, rays, path_light and caption, and seconds or ends = \"touch\" or \"order\"";

impl ShowScene {
    /// The table of a scene, for the file of a show.
    pub(crate) fn to_toml(&self, show: &Path) -> String {
        let mut text = "[[scene]]\n".to_owned();
        let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
        let mut add = |name: &str, value: Option<String>| {
            // Writing to a string cannot fail.
            value.into_iter().for_each(|value| _ = writeln!(text, "{name} = {value}"));
        };
        let relative = |path: &Path| {
            let folder = show.parent().unwrap_or(Path::new(""));
            quoted(&path.strip_prefix(folder).unwrap_or(path).to_string_lossy())
        };
        add("model", self.model.as_deref().map(relative));
        match &self.place {
            Place::Whole => {}
            Place::View(number) => add("view", Some(number.to_string())),
            Place::Path(path) => add("path", Some(relative(path))),
            Place::Camera(camera) => text.push_str(&camera.to_toml()),
        }
        let mut add = |name: &str, value: Option<String>| {
            value.into_iter().for_each(|value| _ = writeln!(text, "{name} = {value}"));
        };
        let shown = |value: Option<&dyn Display>| value.map(|value| quoted(&value.to_string()));
        add("up", shown(self.up.as_ref().map(|it| it as _)));
        add("light", shown(self.light.as_ref().map(|it| it as _)));
        add("clip", shown(self.clip.as_ref().map(|it| it as _)));
        add("rays", shown(self.rays.as_ref().map(|it| it as _)));
        add("path_light", shown(self.path_light.as_ref().map(|it| it as _)));
        add("caption", (!self.caption.is_empty()).then(|| quoted(&self.caption)));
        add("seconds", self.ending.after.map(|after| format!("{:?}", after.as_secs_f64())));
        let ends = if self.ending.by_touch { Some("touch") } else { self.ending.waits.then_some("order") };
        add("ends", ends.map(quoted));
        text
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ShowFile {
    #[serde(default = "usual_fade")]
    fade_seconds: f64,
    #[serde(default = "always")]
    repeat: bool,
    #[serde(default)]
    scene: Vec<Spanned<SceneTable>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneTable {
    model: Option<PathBuf>,
    view: Option<u8>,
    path: Option<PathBuf>,
    eye: Option<DVec3>,
    ll: Option<DVec3>,
    u: Option<DVec3>,
    v: Option<DVec3>,
    up: Option<UpAxis>,
    #[serde(default, deserialize_with = "from_text")]
    light: Option<Light>,
    #[serde(default, deserialize_with = "from_text")]
    clip: Option<Clip>,
    rays: Option<LightingMode>,
    #[serde(default, deserialize_with = "from_text")]
    path_light: Option<PathLight>,
    #[serde(default)]
    caption: String,
    seconds: Option<f64>,
    ends: Option<Ends>,
}

#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Ends {
    Touch,
    Order,
}

impl SceneTable {
    /// The scene, whose model is that of the one before unless it names another.
    fn scene(self, show: &Path, before: Option<&ShowScene>) -> Result<ShowScene, String> {
        let here = |path: PathBuf| show.parent().map_or(path.clone(), |folder| folder.join(path));
        let model = self.model.map(here).or_else(|| before.and_then(|scene| scene.model.clone()));
        let place = match (self.view, self.path, [self.eye, self.ll, self.u, self.v]) {
            (None, None, [None, None, None, None]) => Place::Whole,
            (Some(number), None, [None, None, None, None]) if (1..=9).contains(&number) => Place::View(number),
            (Some(_), None, [None, None, None, None]) => return Err("view is from 1 to 9".to_owned()),
            (None, Some(path), [None, None, None, None]) => Place::Path(here(path)),
            (None, None, [Some(eye), Some(ll), Some(u), Some(v)]) => {
                Place::Camera(Camera::new(eye, ll, u, v).map_err(|error| error.to_string())?)
            }
            _ => return Err("it has one of view, path, or all of eye, ll, u and v".to_owned()),
        };
        let caption = printable_line(&self.caption);
        if caption.chars().count() > MOST_CAPTION {
            return Err(format!("a caption has at most {MOST_CAPTION} characters"));
        }
        if self.seconds.is_some_and(|seconds| !(0.1..=MOST_SECONDS).contains(&seconds)) {
            return Err(format!("seconds are from 0.1 to {MOST_SECONDS}"));
        }
        if self.seconds.is_none() && self.ends.is_none() && !matches!(place, Place::Path(_)) {
            return Err("a scene without a path needs seconds, or ends = \"touch\" or \"order\"".to_owned());
        }
        let ending = Ending {
            after: self.seconds.map(Duration::from_secs_f64),
            by_touch: self.ends == Some(Ends::Touch),
            waits: self.seconds.is_none() && self.ends.is_some(),
        };
        let Self { up, light, clip, rays, path_light, .. } = self;
        Ok(ShowScene { model, place, up, light, clip, rays, path_light, caption, ending })
    }
}

fn usual_fade() -> f64 {
    1.0
}

fn always() -> bool {
    true
}

fn from_text<'de, T: FromStr<Err: Display>, D: Deserializer<'de>>(input: D) -> Result<Option<T>, D::Error> {
    String::deserialize(input)?.parse().map(Some).map_err(D::Error::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Show, String> {
        Show::from_toml(text, Path::new("/shows/tour.toml"))
    }

    #[test]
    fn a_show_is_read_with_its_defaults() {
        let text = "[[scene]]\nmodel = \"a.ply\"\nview = 3\nseconds = 20\n\n[[scene]]\npath = \"a.path.toml\"\n\n\
            [[scene]]\nmodel = \"/b.ply\"\nends = \"touch\"\ncaption = \"Touch to go on\"\nlight = \"10,20\"\n";
        let show = parse(text).unwrap();
        assert_eq!((show.fade, show.repeats), (Duration::from_secs(1), true));
        let models: Vec<_> = show.scenes.iter().map(|scene| scene.model.clone().unwrap()).collect();
        assert_eq!(models, ["/shows/a.ply", "/shows/a.ply", "/b.ply"].map(PathBuf::from));
        assert_eq!(show.scenes[0].place, Place::View(3));
        assert_eq!(show.scenes[1].place, Place::Path("/shows/a.path.toml".into()));
        assert!(!show.scenes[1].ending.waits && show.scenes[2].ending.waits && show.scenes[2].ending.by_touch);
        let unattended = show.clone().unattended();
        assert!(!unattended.scenes[2].ending.waits && unattended.scenes[2].ending.after == Some(Duration::ZERO));
        assert_eq!(parse("").unwrap().scenes, []);
    }

    #[test]
    fn a_fault_names_its_line_and_the_cure() {
        for (text, line, fault) in [
            ("[[scene]]\nview = 3\n", 1, "needs seconds"),
            ("fade_seconds = 11", 1, "from 0 to 10"),
            ("\n[[scene]]\nview = 0\nseconds = 1", 2, "view is from 1 to 9"),
            ("[[scene]]\nseconds = 1\n[[scene]]\nview = 1\npath = \"a\"\nseconds = 1", 3, "one of view, path"),
            ("[[scene]]\nseconds = 1\neye = [0, 0, 0]", 1, "all of eye, ll, u and v"),
            ("[[scene]]\nseconds = 0", 1, "from 0.1"),
            ("[[scene]]\nseconds = 1\nzoom = 2", 3, "unknown field"),
            ("[[scene]]\nseconds = 1\nlight = \"up\"", 3, "AZIMUTH,ELEVATION"),
            ("[[scene]]\nends = \"never\"", 2, "unknown variant"),
        ] {
            let told = parse(text).unwrap_err();
            assert!(told.starts_with(&format!("line {line}: ")) && told.contains(fault), "{told}");
            assert!(!told.contains('\n'), "{told}");
        }
        assert!(parse("[[scene]]\nzoom = 2").unwrap_err().contains("tables [[scene]]"));
        let long = format!("[[scene]]\nseconds = 1\ncaption = \"{}\"", "é".repeat(MOST_CAPTION + 1));
        assert!(parse(&long).unwrap_err().contains("at most 200 characters"));
        assert!(parse(&"[[scene]]\nseconds = 1\n".repeat(MOST_SCENES + 1)).unwrap_err().contains("at most 1000"));
    }

    #[test]
    fn a_caption_is_one_printable_line() {
        let show = parse("[[scene]]\nseconds = 1\ncaption = \"a\\u001b[31m\\nb\\u202e<b>\"").unwrap();
        assert_eq!(show.scenes[0].caption, "a[31m b<b>");
    }

    #[test]
    fn an_added_scene_comes_back_and_the_rest_of_the_file_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tour.toml");
        let begun = "# My tour\nrepeat = false\n\n[[scene]]\nseconds = 2 # short";
        std::fs::write(&path, begun).unwrap();
        let camera = Camera::new(DVec3::Z, DVec3::ZERO, DVec3::X, DVec3::Y).unwrap();
        let scene = ShowScene {
            model: Some(folder.path().join("a \"model\".ply")),
            place: Place::Camera(camera),
            up: Some(UpAxis::Z),
            light: Light::new(10, -20).ok(),
            clip: "x:25".parse().ok(),
            rays: Some(LightingMode::Path),
            path_light: "4,4,0".parse().ok(),
            caption: "The \"crack\" \\ 研究室".to_owned(),
            ending: Ending { after: Some(Duration::from_secs_f64(7.5)), by_touch: true, waits: false },
        };
        let show = add_scene(&path, &scene).unwrap();
        assert_eq!(show.scenes[1], scene);
        assert_eq!(read(&path).unwrap(), show);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.starts_with(begun) && text.contains("model = 'a \"model\".ply'"), "{text}");
        std::fs::write(&path, "scene = 3").unwrap();
        assert!(add_scene(&path, &scene).unwrap_err().starts_with("the scene is not kept: "));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "scene = 3");
        assert!(read(Path::new("/no/tour.toml")).unwrap_err().contains("an empty file begins a new show"));
    }
}
