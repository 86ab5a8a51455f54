//! `mpcdi.xml`: which part of the picture each projector shows, and the files that say how.

use std::{fmt::Write, ops::RangeInclusive};

use roxmltree::{Document, Node, ParsingOptions};

use super::EXPORT_AGAIN;

/// A picture, or what is seen from an eye, and the projectors that show it.
#[derive(Clone, Debug, PartialEq)]
pub struct Mpcdi {
    /// The meaning of warps.
    pub profile: Profile,
    /// Columns and rows of the picture; `None` if the file does not say.
    pub buffer_size: Option<[u32; 2]>,
    /// One for each projector.
    pub regions: Vec<Region>,
}

/// The meaning of a warp's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Profile {
    /// 2d: points of the region, a part of the picture.
    Picture,
    /// 3d: points of the view through the region's frustum.
    View,
    /// a3 and sl: points of the wall in space.
    Space,
}

/// A view from the eye: degrees to the right, upwards and clockwise, by which the eye is turned, in this order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frustum {
    /// Yaw, pitch and roll.
    pub turned: [f64; 3],
    /// Angles from the view's direction to its left, right, upper and lower edge; left and down are negative.
    pub edges: [f64; 4],
}

/// A projector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Region {
    /// Its name.
    pub id: String,
    /// Columns and rows of its pixels.
    pub size: [u32; 2],
    /// The upper-left corner of its part of the picture, which runs from (0, 0) to (1, 1) lower right.
    pub at: [f64; 2],
    /// Width and height of that part.
    pub extent: [f64; 2],
    /// The file of its warp.
    pub warp: String,
    /// The file of its alpha map, which has its part of the light, and the gamma of that map.
    pub alpha: Option<(String, f64)>,
    /// The file of its beta map, which has the light that lifts its black.
    pub beta: Option<String>,
    /// Its view; always there in [`Profile::View`].
    pub frustum: Option<Frustum>,
    /// The unit of its points in space, in metres; `None` if it is unknown.
    pub unit_m: Option<f64>,
}

/// Units of points in space, in metres.
const UNITS: [(&str, f64); 7] =
    [("mm", 1e-3), ("cm", 0.01), ("dm", 0.1), ("m", 1.0), ("in", 0.0254), ("ft", 0.3048), ("yd", 0.9144)];

/// The most projectors of a file.
const MOST_REGIONS: usize = 256;
/// The most elements, attributes and texts of `mpcdi.xml`.
const MOST_NODES: u32 = 100_000;
/// The farthest that the edge of a view may lie from its direction: flat pictures end at 90 degrees.
const MOST_DEGREES: f64 = 89.0;
/// Gammas that were applied to maps; others are mistakes, and count as none.
const GAMMAS: RangeInclusive<f64> = 0.1..=10.0;
/// The most columns or rows of a projector.
pub(super) const LARGEST_SIDE: u32 = 16_384;

impl Mpcdi {
    /// Reads the text of `mpcdi.xml`.
    ///
    /// # Errors
    /// It is not XML, no MPCDI, or of an unknown profile; the text names the cure.
    pub fn read(text: &str) -> Result<Self, String> {
        let options = ParsingOptions { allow_dtd: false, nodes_limit: MOST_NODES, ..ParsingOptions::default() };
        let document = Document::parse_with_options(text, options)
            .map_err(|error| format!("mpcdi.xml: {error}; {EXPORT_AGAIN}"))?;
        let root = document.root_element();
        if !is_named(root, "MPCDI") {
            return Err(format!("mpcdi.xml is no MPCDI, its root is <{}>: {EXPORT_AGAIN}", root.tag_name().name()));
        }
        let profile = attribute(root, "profile").unwrap_or("none");
        let profile = match profile.to_ascii_lowercase().as_str() {
            "2d" => Profile::Picture,
            "3d" => Profile::View,
            "a3" | "sl" => Profile::Space,
            _ => {
                return Err(format!(
                    "its profile is {}, and 2d, 3d, a3 and sl are read: export one of these from the tool that wrote it",
                    profile.escape_default()
                ));
            }
        };
        let display = child(root, "display").ok_or_else(|| format!("mpcdi.xml has no <display>: {EXPORT_AGAIN}"))?;
        let buffers: Vec<Node<'_, '_>> = children(display, "buffer").collect();
        let &[buffer] = &buffers[..] else {
            return Err(format!("it has {} buffers, and a wall shows one picture: split the file", buffers.len()));
        };
        let side = |name: &str| attribute(buffer, name).and_then(|text| text.parse::<u32>().ok()).filter(|n| *n > 0);
        let buffer_size = side("Xresolution").zip(side("Yresolution")).map(<[u32; 2]>::from);
        let filesets: Vec<Node<'_, '_>> =
            child(root, "files").into_iter().flat_map(|files| children(files, "fileset")).collect();
        let regions: Vec<Region> = children(buffer, "region")
            .map(|region| Region::read(region, &filesets, profile))
            .collect::<Result<_, _>>()?;
        if regions.is_empty() || regions.len() > MOST_REGIONS {
            return Err(format!(
                "it has {} regions, and from 1 to {MOST_REGIONS} are possible: {EXPORT_AGAIN}",
                regions.len()
            ));
        }
        Ok(Self { profile, buffer_size, regions })
    }

    /// The text of `mpcdi.xml`, written at a `date` such as `2026-01-31 09:00:00`.
    pub fn write(&self, date: &str) -> String {
        let mut xml = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n");
        let profile = match self.profile {
            Profile::Picture => "2d",
            Profile::View => "3d",
            Profile::Space => "a3",
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            xml,
            "<MPCDI profile=\"{profile}\" geometry=\"1\" level=\"1\" date=\"{date}\" version=\"2.0\">\n  <display>"
        );
        let size = self.buffer_size.map_or(String::new(), |[x, y]| format!(" Xresolution=\"{x}\" Yresolution=\"{y}\""));
        let _ = writeln!(xml, "    <buffer id=\"wall\"{size}>");
        for Region { id, size: [columns, rows], at: [x, y], extent: [width, height], frustum, .. } in &self.regions {
            let _ = writeln!(
                xml,
                "      <region id=\"{}\" Xresolution=\"{columns}\" Yresolution=\"{rows}\" x=\"{x}\" y=\"{y}\" \
                 xsize=\"{width}\" ysize=\"{height}\">",
                escaped(id)
            );
            if let Some(Frustum { turned: [yaw, pitch, roll], edges: [left, right, up, down] }) = frustum {
                let _ = writeln!(
                    xml,
                    "        <frustum><yaw>{yaw}</yaw><pitch>{pitch}</pitch><roll>{roll}</roll>\
                     <rightAngle>{right}</rightAngle><leftAngle>{left}</leftAngle><upAngle>{up}</upAngle>\
                     <downAngle>{down}</downAngle></frustum>"
                );
            }
            xml += "      </region>\n";
        }
        xml += "    </buffer>\n  </display>\n  <files>\n";
        for Region { id, warp, alpha, beta, unit_m, .. } in &self.regions {
            let unit = UNITS.iter().find(|(_, metres)| Some(*metres) == *unit_m).map_or("unknown", |(name, _)| name);
            let (unit, origin) = match self.profile {
                Profile::Space => (unit, "unknown"),
                Profile::Picture | Profile::View => ("2D", "idealEyePoint"),
            };
            let _ = writeln!(xml, "    <fileset region=\"{}\">", escaped(id));
            let _ = writeln!(
                xml,
                "      <geometryWarpFile><path>{}</path><interpolation>linear</interpolation>\
                 <geometricUnit>{unit}</geometricUnit><originof3DData>{origin}</originof3DData></geometryWarpFile>",
                escaped(warp)
            );
            if let Some((path, gamma)) = alpha {
                let _ = writeln!(
                    xml,
                    "      <alphaMap><path>{}</path><componentDepth>3</componentDepth><bitDepth>8</bitDepth>\
                     <gammaEmbedded>{gamma}</gammaEmbedded></alphaMap>",
                    escaped(path)
                );
            }
            if let Some(path) = beta {
                let _ = writeln!(
                    xml,
                    "      <betaMap><path>{}</path><componentDepth>3</componentDepth><bitDepth>8</bitDepth></betaMap>",
                    escaped(path)
                );
            }
            xml += "    </fileset>\n";
        }
        xml + "  </files>\n</MPCDI>\n"
    }
}

impl Region {
    fn read(node: Node<'_, '_>, filesets: &[Node<'_, '_>], profile: Profile) -> Result<Self, String> {
        let id = attribute(node, "id").ok_or_else(|| format!("a <region> has no id: {EXPORT_AGAIN}"))?.to_owned();
        let missing = |what: &str| format!("region \"{id}\" has no {what}: {EXPORT_AGAIN}");
        let number = |name: &str| {
            let value = attribute(node, name).and_then(|text| text.trim().parse::<f64>().ok());
            value.filter(|value| value.is_finite()).ok_or_else(|| missing(&format!("number {name}")))
        };
        let side = |name: &str| {
            let side = attribute(node, name).and_then(|text| text.trim().parse::<u32>().ok());
            side.filter(|side| (1..=LARGEST_SIDE).contains(side))
                .ok_or_else(|| missing(&format!("{name} from 1 to {LARGEST_SIDE}")))
        };
        let fileset = filesets.iter().find(|files| attribute(**files, "region") == Some(&id));
        let fileset = *fileset.ok_or_else(|| missing("<fileset>"))?;
        let path = |node: Node<'_, '_>| Some(text_of(child(node, "path")?));
        let warp_node = child(fileset, "geometryWarpFile");
        let warp =
            warp_node.and_then(path).filter(|path| !path.is_empty()).ok_or_else(|| missing("<geometryWarpFile>"))?;
        let unit = warp_node.and_then(|node| Some(text_of(child(node, "geometricUnit")?)));
        let unit_m = unit.and_then(|unit| Some(UNITS.iter().find(|(name, _)| *name == unit)?.1));
        let frustum = match (profile, child(node, "frustum")) {
            (Profile::View, Some(frustum)) => Some(Frustum::read(frustum).map_err(|what| missing(&what))?),
            (Profile::View, None) => return Err(missing("<frustum>")),
            _ => None,
        };
        let alpha = child(fileset, "alphaMap").and_then(|node| {
            let gamma = child(node, "gammaEmbedded").and_then(|it| text_of(it).parse::<f64>().ok());
            Some((path(node)?, gamma.filter(|gamma| GAMMAS.contains(gamma)).unwrap_or(1.0)))
        });
        let beta = child(fileset, "betaMap").and_then(path);
        let (at, extent) = ([number("x")?, number("y")?], [number("xsize")?, number("ysize")?]);
        let size = [side("Xresolution")?, side("Yresolution")?];
        Ok(Self { size, at, extent, warp, alpha, beta, frustum, unit_m, id })
    }
}

impl Frustum {
    /// # Errors
    /// The part that is missing or impossible.
    fn read(node: Node<'_, '_>) -> Result<Self, String> {
        let degrees = |name: &str| {
            let text = child(node, name).map(text_of).ok_or_else(|| format!("<{name}> in its <frustum>"))?;
            let degrees = text.parse::<f64>().ok().filter(|degrees| degrees.abs() <= 360.0);
            degrees.ok_or_else(|| format!("degrees from -360 to 360 as <{name}>"))
        };
        let turned = [degrees("yaw")?, degrees("pitch")?, degrees("roll")?];
        let edges @ [left, right, up, down] =
            [degrees("leftAngle")?, degrees("rightAngle")?, degrees("upAngle")?, degrees("downAngle")?];
        if !(left < right && down < up && edges.iter().all(|edge| edge.abs() < MOST_DEGREES)) {
            return Err(format!(
                "view between its edges, left < right and down < up, all within {MOST_DEGREES} degrees of its direction"
            ));
        }
        Ok(Self { turned, edges })
    }
}

/// Writers disagree about upper and lower case: `xsize`, `xSize`.
fn attribute<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.attributes().find(|it| it.name().eq_ignore_ascii_case(name)).map(|it| it.value())
}

fn is_named(node: Node<'_, '_>, name: &str) -> bool {
    node.is_element() && node.tag_name().name().eq_ignore_ascii_case(name)
}

fn children<'a, 'input>(node: Node<'a, 'input>, name: &'a str) -> impl Iterator<Item = Node<'a, 'input>> {
    node.children().filter(move |child| is_named(*child, name))
}

fn child<'a, 'input>(node: Node<'a, 'input>, name: &'a str) -> Option<Node<'a, 'input>> {
    children(node, name).next()
}

fn text_of(node: Node<'_, '_>) -> String {
    node.text().unwrap_or_default().trim().to_owned()
}

fn escaped(text: &str) -> String {
    // XML has no control characters.
    let text: String = text.chars().map(|letter| if letter.is_control() { ' ' } else { letter }).collect();
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the library of the standard's authors writes it.
    const THEIRS: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<MPCDI profile="2d" date="2013-05-10 10:00:00" level="2" version="1.0">
    <display>
        <buffer id="Buffer1" Xresolution="1920" Yresolution="1080">
            <region id="proj1" Xresolution="300" Yresolution="200" x="0.1" y="0.2" xsize="0.5" ysize="0.25"/>
        </buffer>
    </display>
    <files>
        <fileset region="proj1">
            <geometryWarpFile><path>proj1_warp.pfm</path><geometricUnit>2D</geometricUnit>
                <interpolation>linear</interpolation><originof3DData>centerOfMass</originof3DData></geometryWarpFile>
            <alphaMap><path>proj1_alpha.png</path><componentDepth>1</componentDepth><bitDepth>8</bitDepth>
                <gammaEmbedded>2.2</gammaEmbedded></alphaMap>
        </fileset>
    </files>
</MPCDI>"#;

    #[test]
    fn files_of_others_are_read_whatever_the_case_of_their_names() {
        let read = Mpcdi::read(THEIRS).expect("MPCDI");
        assert_eq!(read.buffer_size, Some([1920, 1080]));
        let region = Region {
            id: "proj1".to_owned(),
            size: [300, 200],
            at: [0.1, 0.2],
            extent: [0.5, 0.25],
            warp: "proj1_warp.pfm".to_owned(),
            alpha: Some(("proj1_alpha.png".to_owned(), 2.2)),
            ..Region::default()
        };
        assert_eq!((read.profile, &read.regions[..]), (Profile::Picture, &[region][..]));
        let others = THEIRS.replace("xsize", "xSize").replace("Xresolution", "xResolution").replace("ysize", "ySize");
        assert_eq!(Mpcdi::read(&others), Ok(read));
    }

    #[test]
    fn what_is_written_is_read_again() {
        let region = |id: &str| Region {
            id: id.to_owned(),
            size: [1024, 768],
            at: [1.0 / 3.0, 0.0],
            extent: [0.4, 1.0],
            warp: "a/b.pfm".to_owned(),
            alpha: Some(("a.png".to_owned(), 2.2)),
            beta: Some("b.png".to_owned()),
            ..Region::default()
        };
        let plain = vec![region("row 1"), region("<\"&'>")];
        let with = |frustum, unit_m| plain.iter().map(|it| Region { frustum, unit_m, ..it.clone() }).collect();
        let frustum = Frustum { turned: [-54.5, 30.25, 7.0], edges: [-26.0, 25.5, 20.0, -21.0] };
        for (profile, regions) in [
            (Profile::Picture, plain.clone()),
            (Profile::View, with(Some(frustum), None)),
            (Profile::Space, with(None, Some(0.0254))),
        ] {
            let mpcdi = Mpcdi { profile, buffer_size: Some([4096, 2304]), regions };
            assert_eq!(Mpcdi::read(&mpcdi.write("2026-01-31 09:00:00")), Ok(mpcdi));
        }
    }

    #[test]
    fn what_is_no_mpcdi_is_refused_in_one_line() {
        let refused = |text: &str, cause: &str| {
            let fault = Mpcdi::read(text).expect_err(cause);
            assert!(fault.contains(cause) && !fault.contains('\n'), "{fault}");
            assert!(fault.contains("export "), "no cure: {fault}");
        };
        refused("", "mpcdi.xml: ");
        refused("<a/>", "its root is <a>");
        refused(&THEIRS.replace("profile=\"2d\"", "profile=\"4d\""), "its profile is 4d");
        refused(&THEIRS.replace("profile=\"2d\"", "profile=\"3d\""), "\"proj1\" has no <frustum>");
        let view = |edges: [&str; 4]| {
            let [left, right, up, down] = edges;
            let frustum = format!(
                "><frustum><yaw>5</yaw><pitch>-10</pitch><roll>7</roll><rightAngle>{right}</rightAngle>\
                 <leftAngle>{left}</leftAngle><upAngle>{up}</upAngle><downAngle>{down}</downAngle></frustum></region>"
            );
            THEIRS.replace("profile=\"2d\"", "profile=\"3d\"").replacen("/>", &frustum, 1)
        };
        let read = Mpcdi::read(&view(["-20", "12", "10", "-10"])).expect("MPCDI");
        let expected = Frustum { turned: [5.0, -10.0, 7.0], edges: [-20.0, 12.0, 10.0, -10.0] };
        assert_eq!((read.profile, read.regions[0].frustum), (Profile::View, Some(expected)));
        refused(&view(["20", "12", "10", "-10"]), "no view between its edges");
        refused(&view(["-20", "90", "10", "-10"]), "no view between its edges");
        refused(&view(["-20", "x", "10", "-10"]), "no degrees from -360 to 360 as <rightAngle>");
        refused(&THEIRS.replace("<region id=\"proj1\"", "<region id=\"proj2\""), "\"proj2\" has no <fileset>");
        refused(&THEIRS.replace("\"300\"", "\"0\""), "no Xresolution from 1 to");
        refused(&THEIRS.replace("\"0.1\"", "\"NaN\""), "no number x");
        refused("<!DOCTYPE a [<!ENTITY b \"bb\">]><MPCDI>&b;</MPCDI>", "mpcdi.xml: ");
        let deep = format!("{}{}", "<a>".repeat(200_000), "</a>".repeat(200_000));
        refused(&deep, "mpcdi.xml: ");
    }
}
