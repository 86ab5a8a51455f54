//! The types that ply-rs fills row by row. Properties are named by their role: see [`super::header::Element::def`].

use glam::DVec3;
use ply_rs::ply::{BeginList, Property, PropertyAccess, PropertyAccessResult};

pub(super) struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

pub(super) struct Vertex {
    pub(super) position: DVec3,
    pub(super) color: [u8; 3],
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: DVec3::ZERO, color: [0; 3] }
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
        let number = match value {
            Property::Int(v) => v.into(),
            Property::UInt(v) => v.into(),
            Property::Double(v) => v,
            // The others fit `f32`.
            _ => match value.to_f32_lossy() {
                Some(v) => v.into(),
                None => return PropertyAccessResult::Ignored,
            },
        };
        // `as` saturates, and takes NaN to 0.
        let color = match value {
            Property::UShort(v) => ((u32::from(v) * 255 + 32767) / 65535) as u8,
            Property::Float(v) => (v * 255.0).round() as u8,
            Property::Double(v) => (v * 255.0).round() as u8,
            _ => number as u8,
        };
        match role {
            "x" => self.position.x = number,
            "y" => self.position.y = number,
            "z" => self.position.z = number,
            "r" => self.color[0] = color,
            "g" => self.color[1] = color,
            "b" => self.color[2] = color,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

pub(super) struct Corners {
    /// [`u32::MAX`], which no vertex has, replaces an index that is no `u32`.
    pub(super) indices: Vec<u32>,
}

impl PropertyAccess for Corners {
    fn new() -> Self {
        Self { indices: Vec::new() }
    }

    fn begin_list_uint(&mut self, role: &str, _len: usize) -> BeginList<'_, u32> {
        if role == "i" { BeginList::Fill(&mut self.indices) } else { BeginList::UseSetter }
    }

    fn set_property(&mut self, role: &str, value: Property) -> PropertyAccessResult {
        if role != "i" {
            return PropertyAccessResult::Ignored;
        }
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

/// The index equal to `value`, if there is one.
pub(super) fn index_from_f64(value: f64) -> Option<u32> {
    let index = value as u32;
    (f64::from(index) == value).then_some(index)
}

fn indices<T>(list: Vec<T>, index: impl Fn(T) -> Option<u32>) -> Vec<u32> {
    // In place where `T` is as wide as `u32`.
    list.into_iter().map(|value| index(value).unwrap_or(u32::MAX)).collect()
}
