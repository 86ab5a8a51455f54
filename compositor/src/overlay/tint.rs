//! Colours over the picture: the render server of each part, or its cost.

use egui::{Color32, ColorImage, LayerId, Pos2, TextureHandle, TextureOptions, Ui};
use shared::division::{FrameSize, Share, TILE_SIZE};

use super::OverlayModel;
use crate::{
    control::input::Tint,
    farm::stats::{FrameStats, FrameTask, NodeId},
};

/// Okabe and Ito's colours without black, which colour-blind people can tell apart: "Color Universal Design", 2008,
/// <https://jfly.uni-koeln.de/color/>. Those that differ least are far from each other.
const NODE_COLORS: [[u8; 3]; 7] =
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [204, 121, 167], [0, 114, 178], [213, 94, 0]];

/// The colour of a render server: very different from those that joined before and after it.
pub(super) fn node_color(NodeId(id): NodeId) -> Color32 {
    let index = id.wrapping_sub(1) as usize;
    let [r, g, b] = NODE_COLORS[index % NODE_COLORS.len()];
    let is_darker = index / NODE_COLORS.len() % 2 == 1;
    let color = Color32::from_rgb(r, g, b);
    if is_darker { color.lerp_to_gamma(Color32::BLACK, 0.45) } else { color }
}

const OPACITY: f32 = 0.45;
/// Units at least this large on screen have sharp edges, in physical pixels; smaller ones would make a moiré.
const SHARP_PX: f32 = 4.0;

/// A tint on the GPU.
#[derive(Clone)]
struct Shown {
    frame: u64,
    tint: Tint,
    n_merged: u32,
    texture: TextureHandle,
}

/// Draws the tint over the picture, under all panels.
pub(super) fn show(ui: &Ui, model: &OverlayModel) {
    let (Some(frame), tint) = (&model.frame, model.tint) else { return };
    if tint == Tint::None || frame.tasks.is_empty() {
        return;
    }
    let unit = unit_side(frame) as f32;
    let unit_px = unit_pixels(model, size_vec(frame.size) / unit) * ui.pixels_per_point();
    // Units smaller than a pixel are merged.
    let n_merged = if unit_px < 1.0 { (1.0 / unit_px).ceil().min(MOST_MERGED) as u32 } else { 1 };
    let id = egui::Id::unique("tint");
    let cached: Option<Shown> = ui.data(|data| data.get_temp(id));
    let is_current = |it: &Shown| (it.frame, it.tint, it.n_merged) == (frame.frame, tint, n_merged);
    let shown = cached.filter(is_current).unwrap_or_else(|| {
        let is_sharp = unit_px * n_merged as f32 >= SHARP_PX;
        let options = if is_sharp { TextureOptions::NEAREST } else { TextureOptions::LINEAR };
        let texture = ui.ctx().load_texture("tint", merged(&image(tint, frame), n_merged as usize), options);
        let shown = Shown { frame: frame.frame, tint, n_merged, texture };
        ui.data_mut(|data| data.insert_temp(id, shown.clone()));
        shown
    });
    // The last units may extend beyond the frame.
    let frame_in_texture = size_vec(frame.size) / (shown.texture.size_vec2() * unit * n_merged as f32);
    let painter = ui.ctx().layer_painter(LayerId::background());
    for region in &model.regions {
        // Row 0 of a frame and of its texture is at the bottom.
        let uv = |point: Pos2| (egui::vec2(point.x, 1.0 - point.y) * frame_in_texture).to_pos2();
        let color = Color32::WHITE.gamma_multiply(OPACITY);
        painter.with_clip_rect(region.window).add(region.textured(shown.texture.id(), color, uv));
    }
}

/// Units merged along each side, at most.
const MOST_MERGED: f32 = 256.0;

/// The least side of a unit on screen, in points, if the canvas has this many columns and rows of them.
fn unit_pixels(model: &OverlayModel, n_units: egui::Vec2) -> f32 {
    let unit = model.regions.iter().map(|region| region.window.size() / (region.canvas.size() * n_units));
    unit.map(egui::Vec2::min_elem).fold(f32::INFINITY, f32::min).max(f32::MIN_POSITIVE)
}

/// Each square of `n` texels a side becomes one, of their mean colour.
fn merged(image: &ColorImage, n: usize) -> ColorImage {
    if n == 1 {
        return image.clone();
    }
    let [width, height] = image.size;
    let mean = |(left, top): (usize, usize)| {
        let rows =
            (top..(top + n).min(height)).map(|y| &image.pixels[y * width + left..y * width + (left + n).min(width)]);
        let (mut sum, mut count) = ([0; 4], 0);
        for texel in rows.flatten() {
            sum.iter_mut().zip(texel.to_array()).for_each(|(sum, channel)| *sum += u32::from(channel));
            count += 1;
        }
        let [r, g, b, a] = sum.map(|sum| (sum / count) as u8);
        Color32::from_rgba_premultiplied(r, g, b, a)
    };
    let corners = (0..height).step_by(n).flat_map(|top| (0..width).step_by(n).map(move |left| (left, top)));
    ColorImage::new([width.div_ceil(n), height.div_ceil(n)], corners.map(mean).collect())
}

pub(super) fn mark_pick(ui: &Ui, model: &OverlayModel) {
    let Some(point) = model.pick_on_canvas else { return };
    let painter = ui.ctx().layer_painter(LayerId::background());
    // Where projectors overlap, each shows its part of the mark.
    for at in model.regions.iter().filter_map(|region| region.window_position(point)) {
        painter.circle_stroke(at, 9.0, egui::Stroke::new(4.0, Color32::from_black_alpha(160)));
        painter.circle_stroke(at, 9.0, egui::Stroke::new(2.0, super::style::ACCENT));
        painter.circle_filled(at, 1.5, super::style::ACCENT);
    }
}

fn size_vec(size: FrameSize) -> egui::Vec2 {
    egui::vec2(size.xres() as f32, size.yres() as f32)
}

fn shares(frame: &FrameStats) -> impl Iterator<Item = (&FrameTask, Share)> {
    frame.tasks.iter().filter_map(|task| Some((task, task.task.share(frame.size).ok()?)))
}

/// The side of a unit in samples: of a tile, or of a sample if the frame is interleaved.
fn unit_side(frame: &FrameStats) -> u32 {
    if shares(frame).any(|(_, share)| share.units().samples_per_full_unit() > 1) { TILE_SIZE } else { 1 }
}

/// One texel for each unit of the frame, bottom row first.
fn image(tint: Tint, frame: &FrameStats) -> ColorImage {
    let (size, unit) = (frame.size, unit_side(frame));
    let texels = [size.xres().div_ceil(unit), size.yres().div_ceil(unit)].map(|side| side as usize);
    let mut image = ColorImage::filled(texels, Color32::TRANSPARENT);
    let mut set = |share: &Share, k: u32, color: Color32| {
        let samples = share.samples(k);
        let (column, row) = (samples.columns.start / unit, samples.rows.start / unit);
        if let Some(texel) = image.pixels.get_mut(row as usize * texels[0] + column as usize) {
            *texel = color;
        }
    };
    match tint {
        Tint::None => {}
        Tint::Nodes => {
            for (task, share) in shares(frame) {
                (0..share.count()).for_each(|k| set(&share, k, node_color(task.node)));
            }
        }
        Tint::Cost => {
            let (most, _) = usual_most_ns(frame);
            for (task, share) in shares(frame) {
                (0..).zip(unit_costs(task, &share)).for_each(|(k, cost)| set(&share, k, heat(cost / most)));
            }
        }
    }
    image
}

/// CPU time of each unit of a task in nanoseconds: its run's mean, or the task's if no runs were measured.
fn unit_costs(task: &FrameTask, share: &Share) -> Vec<f32> {
    let n_units = share.count();
    let mean = task.trace_cpu_ns as f32 / n_units.max(1) as f32;
    let mut costs = vec![mean; n_units as usize];
    if task.costs.fits(n_units) {
        for (units, cpu_ns) in task.costs.runs(n_units) {
            let each = cpu_ns as f32 / units.len().max(1) as f32;
            units.for_each(|k| costs[k as usize] = each);
        }
    }
    costs
}

/// The cost at the end of the scale, in nanoseconds above zero, and the name of a unit.
///
/// The 99th percentile: one tile during which a node was interrupted does not make all others look free.
pub(super) fn usual_most_ns(frame: &FrameStats) -> (f32, &'static str) {
    let mut sorted: Vec<f32> = shares(frame).flat_map(|(task, share)| unit_costs(task, &share)).collect();
    let nth = sorted.len().saturating_sub(1) * 99 / 100;
    let most = if sorted.is_empty() { 0.0 } else { *sorted.select_nth_unstable_by(nth, f32::total_cmp).1 };
    (most.max(f32::MIN_POSITIVE), if unit_side(frame) > 1 { "tile" } else { "sample" })
}

/// The colour of a part of the scale, from dark at 0 to bright at 1: viridis, by Smith and van der Walt, whose order
/// colour-blind people see too.
pub(super) fn heat(part: f32) -> Color32 {
    const STOPS: [[u8; 3]; 9] = [
        [68, 1, 84],
        [71, 44, 122],
        [59, 81, 139],
        [44, 113, 142],
        [33, 144, 141],
        [39, 173, 129],
        [92, 200, 99],
        [170, 220, 50],
        [253, 231, 37],
    ];
    let at = part.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let index = (at as usize).min(STOPS.len() - 2);
    let [from, to] =
        [index, index + 1].map(|index| Color32::from_rgb(STOPS[index][0], STOPS[index][1], STOPS[index][2]));
    from.lerp_to_gamma(to, at - index as f32)
}

#[cfg(test)]
mod tests {
    use shared::{division::Division, protocol::RunCosts};

    use super::*;
    use crate::overlay::tests::running;

    fn frame(division: Division, size: [u32; 2], machines: u32) -> FrameStats {
        let tasks = (0..machines).map(|machine| FrameTask {
            node: NodeId(machine + 1),
            task: division.task(machine, machines),
            trace_cpu_ns: 1000 * (u64::from(machine) + 1),
            costs: RunCosts::default(),
        });
        let size = FrameSize::new(size[0], size[1]).unwrap();
        FrameStats { size, tasks: tasks.collect(), ..running().frame.unwrap() }
    }

    #[test]
    fn each_unit_has_the_color_of_who_rendered_it() {
        let tiled = image(Tint::Nodes, &frame(Division::Tiled, [20, 9], 4));
        assert_eq!(tiled.size, [3, 2]);
        let expected: Vec<_> = (0..6).map(|tile| node_color(NodeId(tile % 4 + 1))).collect();
        assert_eq!(tiled.pixels, expected);
        let interleaved = image(Tint::Nodes, &frame(Division::Interleaved, [5, 2], 3));
        assert_eq!(interleaved.size, [5, 2]);
        let expected: Vec<_> = (0..10).map(|sample| node_color(NodeId(sample % 3 + 1))).collect();
        assert_eq!(interleaved.pixels, expected);
    }

    #[test]
    fn measured_blocks_have_their_own_colors_and_others_the_mean() {
        let mut frame = frame(Division::Dynamic, [32, 8], 1);
        assert_eq!(image(Tint::Cost, &frame).pixels, vec![heat(1.0); 4], "one cost for all");
        let mut tasks = frame.tasks.to_vec();
        tasks[0].costs = RunCosts { run_units: 2, cpu_ns: vec![100, 900] };
        frame.tasks = tasks.into();
        let mut colors = image(Tint::Cost, &frame).pixels;
        colors.sort_by_key(Color32::to_array);
        let mut expected = [50.0, 50.0, 450.0, 450.0].map(|cost: f32| heat(cost / 450.0));
        expected.sort_by_key(Color32::to_array);
        assert_eq!(colors, expected);
    }

    #[test]
    fn units_smaller_than_a_pixel_are_merged_into_their_mean() {
        let interleaved = image(Tint::Nodes, &frame(Division::Interleaved, [6, 3], 2));
        let half = merged(&interleaved, 2);
        assert_eq!(half.size, [3, 2]);
        let [a, b] = [1, 2].map(|id| node_color(NodeId(id)).to_array());
        let mean = half.pixels[0].to_array();
        assert!((0..4).all(|channel| mean[channel] == ((u32::from(a[channel]) + u32::from(b[channel])) / 2) as u8));
        assert!(half.pixels.iter().all(|&pixel| pixel == half.pixels[0]), "no moiré: {half:?}");
    }

    #[test]
    fn higher_costs_are_brighter() {
        let brightness = |step: u8| heat(f32::from(step) / 20.0).intensity();
        assert!((0..20).all(|step| brightness(step) < brightness(step + 1)));
        assert_eq!((heat(-1.0), heat(2.0)), (heat(0.0), heat(1.0)));
    }

    #[test]
    fn neighbours_in_the_list_of_nodes_differ_in_color() {
        let colors: Vec<_> = (1..=12).map(|id| node_color(NodeId(id))).collect();
        let distance = |a: Color32, b: Color32| {
            let channels = a.to_array().into_iter().zip(b.to_array());
            channels.map(|(a, b)| u32::from(a.abs_diff(b))).sum::<u32>()
        };
        for (index, &color) in colors.iter().enumerate() {
            assert!(colors[..index].iter().all(|&other| distance(color, other) > 60), "{index}: {colors:?}");
        }
    }
}
