//! The types that ply-rs fills row by row. Properties are named by their role: see [`super::header::Element::def`].

use glam::DVec3;
use ply_rs::ply::{BeginList, Property, PropertyAccess, PropertyAccessResult};

use crate::formats::assembly::index_from_f64;

pub(super) struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

pub(super) struct Vertex {
    pub(super) position: DVec3,
    pub(super) color: [u8; 3],
    pub(super) normal: [f32; 3],
    /// With v from the lower edge.
    pub(super) texture_coordinates: [f32; 2],
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: DVec3::ZERO, color: [0; 3], normal: [0.0; 3], texture_coordinates: [0.0; 2] }
    }

    fn set_float(&mut self, role: &str, value: f32) -> PropertyAccessResult {
        match role {
            "x" => self.position.x = value.into(),
            "y" => self.position.y = value.into(),
            "z" => self.position.z = value.into(),
            _ => return self.set_property(role, Property::Float(value)),
        }
        PropertyAccessResult::Set
    }

    fn set_property(&mut self, role: &str, value: Property) -> PropertyAccessResult {
        let Some(number) = number(&value) else { return PropertyAccessResult::Ignored };
        match role {
            "x" => self.position.x = number,
            "y" => self.position.y = number,
            "z" => self.position.z = number,
            "r" => self.color[0] = color(&value),
            "g" => self.color[1] = color(&value),
            "b" => self.color[2] = color(&value),
            "nx" => self.normal[0] = number as f32,
            "ny" => self.normal[1] = number as f32,
            "nz" => self.normal[2] = number as f32,
            "s" => self.texture_coordinates[0] = number as f32,
            "t" => self.texture_coordinates[1] = number as f32,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

fn number(value: &Property) -> Option<f64> {
    match *value {
        Property::Int(v) => Some(v.into()),
        Property::UInt(v) => Some(v.into()),
        Property::Double(v) => Some(v),
        // The others fit `f32`.
        _ => value.to_f32_lossy().map(f64::from),
    }
}

fn color(value: &Property) -> u8 {
    // `as` saturates, and takes NaN to 0.
    match *value {
        Property::UShort(v) => ((u32::from(v) * 255 + 32767) / 65535) as u8,
        Property::Float(v) => (v * 255.0).round() as u8,
        Property::Double(v) => (v * 255.0).round() as u8,
        _ => number(value).unwrap_or(0.0) as u8,
    }
}

pub(super) struct Corners {
    /// [`u32::MAX`], which no vertex has, replaces an index that is no `u32`.
    pub(super) indices: Vec<u32>,
    /// Two numbers for each corner, with v from the lower edge.
    pub(super) texture_coordinates: Vec<f32>,
    /// The number of the texture; [`u16::MAX`] for none, which files call −1.
    pub(super) texture: u16,
    pub(super) color: [u8; 3],
}

impl PropertyAccess for Corners {
    fn new() -> Self {
        Self { indices: Vec::new(), texture_coordinates: Vec::new(), texture: 0, color: [0; 3] }
    }

    fn begin_list_uint(&mut self, role: &str, _len: usize) -> BeginList<'_, u32> {
        if role == "i" { BeginList::Fill(&mut self.indices) } else { BeginList::UseSetter }
    }

    fn set_property(&mut self, role: &str, value: Property) -> PropertyAccessResult {
        match role {
            "i" => return self.set_indices(value),
            "c" => {
                self.texture_coordinates = match value {
                    Property::ListFloat(list) => list,
                    Property::ListDouble(list) => list.into_iter().map(|number| number as f32).collect(),
                    _ => return PropertyAccessResult::Ignored,
                }
            }
            "n" => self.texture = number(&value).and_then(|it| u16::try_from(it as i64).ok()).unwrap_or(u16::MAX),
            "r" => self.color[0] = color(&value),
            "g" => self.color[1] = color(&value),
            "b" => self.color[2] = color(&value),
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

impl Corners {
    fn set_indices(&mut self, value: Property) -> PropertyAccessResult {
        self.indices = match value {
            Property::ListChar(list) => indices(list, |v| v.try_into().ok()),
            Property::ListUChar(list) => indices(list, |v| Some(v.into())),
            Property::ListShort(list) => indices(list, |v| v.try_into().ok()),
            Property::ListUShort(list) => indices(list, |v| Some(v.into())),
            Property::ListInt(list) => indices(list, |v| v.try_into().ok()),
            Property::ListUInt(list) => list,
            Property::ListFloat(list) => indices(list, |v| index_from_f64(v.into())),
            Property::ListDouble(list) => indices(list, index_from_f64),
            _ => return PropertyAccessResult::Ignored,
        };
        PropertyAccessResult::Set
    }
}

fn indices<T>(list: Vec<T>, index: impl Fn(T) -> Option<u32>) -> Vec<u32> {
    // In place where `T` is as wide as `u32`.
    list.into_iter().map(|value| index(value).unwrap_or(u32::MAX)).collect()
}
