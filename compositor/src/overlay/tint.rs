//! Colours over the picture: the render server of each part, or its cost.

use egui::{Color32, ColorImage, LayerId, Pos2, TextureHandle, TextureOptions, Ui, ecolor::Hsva};
use shared::division::{FrameSize, Share, TILE_SIZE};

use super::OverlayModel;
use crate::{
    control::input::Tint,
    farm::stats::{FrameStats, FrameTask, NodeId},
};

/// The colour of a render server: very different from those that joined before and after it.
pub(super) fn node_color(NodeId(id): NodeId) -> Color32 {
    // Steps of the golden ratio around the circle of hues; every second group of eight is darker.
    let value = if id.wrapping_sub(1) / 8 % 2 == 0 { 0.95 } else { 0.55 };
    Hsva::new((id as f32 * 0.618_034).fract(), 0.9, value, 1.0).into()
}

const OPACITY: f32 = 0.45;

/// Draws the tint over the picture, under all panels.
pub(super) fn show(ui: &Ui, model: &OverlayModel) {
    let (Some(frame), tint) = (&model.frame, model.tint) else { return };
    if tint == Tint::None || frame.tasks.is_empty() {
        return;
    }
    let id = egui::Id::unique("tint");
    let cached: Option<(u64, Tint, TextureHandle)> = ui.data(|data| data.get_temp(id));
    let texture = match cached {
        Some((number, of, texture)) if (number, of) == (frame.frame, tint) => texture,
        _ => {
            let texture = ui.ctx().load_texture("tint", image(tint, frame), TextureOptions::NEAREST);
            ui.data_mut(|data| data.insert_temp(id, (frame.frame, tint, texture.clone())));
            texture
        }
    };
    // The last tiles may extend beyond the frame.
    let texels = texture.size_vec2();
    let unit = if texels == size_vec(frame.size) { 1.0 } else { TILE_SIZE as f32 };
    let frame_in_texture = size_vec(frame.size) / (texels * unit);
    let painter = ui.ctx().layer_painter(LayerId::background());
    for region in &model.regions {
        // Row 0 of a frame and of its texture is at the bottom.
        let uv = |point: Pos2| (egui::vec2(point.x, 1.0 - point.y) * frame_in_texture).to_pos2();
        let color = Color32::WHITE.gamma_multiply(OPACITY);
        painter.with_clip_rect(region.window).add(region.textured(texture.id(), color, uv));
    }
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

/// One texel for each unit of the frame, bottom row first: a tile, or a sample if the frame is interleaved.
fn image(tint: Tint, frame: &FrameStats) -> ColorImage {
    let size = frame.size;
    let shares = || frame.tasks.iter().filter_map(|task| Some((task, task.task.share(size).ok()?)));
    let is_by_tiles = shares().any(|(_, share)| share.units().samples_per_full_unit() > 1);
    let unit = if is_by_tiles { TILE_SIZE } else { 1 };
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
            for (task, share) in shares() {
                (0..share.count()).for_each(|k| set(&share, k, node_color(task.node)));
            }
        }
        Tint::Cost => {
            let costs: Vec<_> = shares().map(|(task, share)| unit_costs(task, &share)).collect();
            let most = usual_most(costs.iter().flatten().copied());
            for ((_, share), costs) in shares().zip(&costs) {
                (0..).zip(costs).for_each(|(k, &cost)| set(&share, k, heat(cost, most)));
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

/// The 99th percentile: one tile during which a node was interrupted does not make all others look free.
fn usual_most(costs: impl Iterator<Item = f32>) -> f32 {
    let mut sorted: Vec<f32> = costs.collect();
    sorted.sort_by(f32::total_cmp);
    sorted.get(sorted.len().saturating_sub(1) * 99 / 100).copied().unwrap_or(0.0)
}

/// From blue at 0 over yellow to red.
fn heat(cost: f32, most: f32) -> Color32 {
    let part = if most > 0.0 { (cost / most).clamp(0.0, 1.0) } else { 0.0 };
    let stops = [[30.0, 60.0, 200.0], [250.0, 220.0, 60.0], [230.0, 40.0, 30.0]];
    let (index, within) = if part < 0.5 { (0, part * 2.0) } else { (1, part * 2.0 - 1.0) };
    let [r, g, b] = [0, 1, 2].map(|channel: usize| {
        let (from, to): (f32, f32) = (stops[index][channel], stops[index + 1][channel]);
        (from + (to - from) * within) as u8
    });
    Color32::from_rgb(r, g, b)
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
        assert_eq!(image(Tint::Cost, &frame).pixels, vec![heat(1.0, 1.0); 4], "one cost for all");
        let mut tasks = frame.tasks.to_vec();
        tasks[0].costs = RunCosts { run_units: 2, cpu_ns: vec![100, 900] };
        frame.tasks = tasks.into();
        let mut colors = image(Tint::Cost, &frame).pixels;
        colors.sort_by_key(Color32::to_array);
        let mut expected = [50.0, 50.0, 450.0, 450.0].map(|cost| heat(cost, 450.0));
        expected.sort_by_key(Color32::to_array);
        assert_eq!(colors, expected);
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
