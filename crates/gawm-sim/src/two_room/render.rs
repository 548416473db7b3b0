//! How a TwoRoom looks. Equal to the published renderer, pixel by pixel.

use super::config::{BORDER_PX, TwoRoomConfig, WALL_CENTER_PX, WORLD_SIZE_PX};
use crate::environment::Frame;
use crate::exp::{ExpTable, LOWEST_ARGUMENT};

/// Side of a frame in pixels.
pub const FRAME_SIZE: usize = WORLD_SIZE_PX as usize;
/// Values of a row of pixels.
const ROW_VALUES: usize = FRAME_SIZE * 3;
/// Thickness of the border's line.
const BORDER_LINE_PX: usize = 4;
/// A pixel whose exponent is this far below the largest has a weight under 2^-25: its blend rounds to what was there.
const VISIBLE_RANGE: f32 = 17.5;
/// A dot whose largest exponent is below this is not drawn: its centre is some 78 pixels or more outside of the image,
/// where no step leads. From here down, a dot's weights would not all be normal numbers.
const LOWEST_PEAK: f32 = LOWEST_ARGUMENT + VISIBLE_RANGE + 6.0;

/// Draws the frames of one configuration.
#[derive(Clone, Debug)]
pub struct Renderer {
    /// The rooms without agent and target. Shape [224, 224, 3].
    rooms: Vec<u8>,
    agent: Dot,
    target: Option<Dot>,
}

/// A Gaussian dot: its width and colour.
#[derive(Clone, Debug)]
struct Dot {
    /// Two variances.
    denominator: f32,
    /// The colour of each pixel of a row. Shape [224, 3].
    colors: [f32; ROW_VALUES],
}

impl Dot {
    fn new(radius_px: f32, color: [u8; 3]) -> Self {
        let std = f64::from(radius_px);
        let colors = std::array::from_fn(|i| f32::from(color[i % 3]));
        Dot { denominator: (2.0 * std * std) as f32, colors }
    }
}

impl Renderer {
    /// Prepares the rooms. Call [`TwoRoomConfig::check`] first.
    pub fn new(config: &TwoRoomConfig) -> Self {
        Renderer {
            rooms: draw_rooms(config),
            agent: Dot::new(config.agent_radius_px, config.colors.agent),
            target: config.render_target.then(|| Dot::new(config.target_radius_px, config.colors.target)),
        }
    }

    /// Draws an agent (and a target, where the configuration shows it) into `frame`.
    pub fn render(&self, agent: [f32; 2], target: [f32; 2], frame: &mut Frame) {
        (frame.width, frame.height) = (FRAME_SIZE, FRAME_SIZE);
        frame.rgb.clear();
        frame.rgb.extend_from_slice(&self.rooms);
        if let Some(dot) = &self.target {
            blend_dot(&mut frame.rgb, dot, target);
        }
        blend_dot(&mut frame.rgb, &self.agent, agent);
    }
}

/// Draws background, doors, wall and border. Shape [224, 224, 3].
fn draw_rooms(config: &TwoRoomConfig) -> Vec<u8> {
    let half = (config.wall_thickness_px / 2) as usize;
    let center = WALL_CENTER_PX as usize;
    let border = BORDER_PX as usize;
    let far = FRAME_SIZE - border;
    let on_border =
        |i: usize| (border - BORDER_LINE_PX..border).contains(&i) || (far..far + BORDER_LINE_PX).contains(&i);
    let in_door = |along: usize| {
        config.doors.iter().any(|d| along.abs_diff(d.center_px.into()) <= d.half_extent_px.into())
    };
    let mut rgb = Vec::with_capacity(FRAME_SIZE * FRAME_SIZE * 3);
    for y in 0..FRAME_SIZE {
        for x in 0..FRAME_SIZE {
            let at = [x, y];
            let in_wall = at[config.wall_axis.across()].abs_diff(center) <= half;
            let color = if on_border(x) || on_border(y) {
                config.colors.wall
            } else if !in_wall {
                config.colors.background
            } else if in_door(at[config.wall_axis.along()]) {
                config.colors.door
            } else {
                config.colors.wall
            };
            rgb.extend_from_slice(&color);
        }
    }
    rgb
}

/// Blends a dot over an image of shape [224, 224, 3].
///
/// The weight of a pixel is its Gaussian, divided by the largest of the image: a dot beyond the edge still shows.
fn blend_dot(rgb: &mut [u8], dot: &Dot, center: [f32; 2]) {
    let table = ExpTable::get();
    let squares =
        center.map(|c| std::array::from_fn::<f32, FRAME_SIZE, _>(|i| (i as f32 - c) * (i as f32 - c)));
    let exponent = |x: usize, y: usize| -(squares[0][x] + squares[1][y]) / dot.denominator;
    let nearest = center.map(|c| c.round().clamp(0.0, (FRAME_SIZE - 1) as f32) as usize);
    let largest_exponent = exponent(nearest[0], nearest[1]);
    if largest_exponent < LOWEST_PEAK {
        return;
    }
    let peak = peak_weight(nearest, |x, y| table.exp(exponent(x, y)));
    let reach_squared = (VISIBLE_RANGE - largest_exponent) * dot.denominator;
    let mut weights = [0.0_f32; FRAME_SIZE];
    let mut value_weights = [0.0_f32; ROW_VALUES];
    for y in pixels_within(center[1], reach_squared) {
        let columns = pixels_within(center[0], reach_squared - squares[1][y]);
        let weights = &mut weights[..columns.len()];
        for (weight, &dx_squared) in weights.iter_mut().zip(&squares[0][columns.clone()]) {
            *weight = -(dx_squared + squares[1][y]) / dot.denominator;
        }
        table.exp_row(weights);
        for (of_pixel, weight) in value_weights.chunks_exact_mut(3).zip(&*weights) {
            of_pixel.fill(weight / peak);
        }
        let row = &mut rgb[(y * FRAME_SIZE + columns.start) * 3..(y * FRAME_SIZE + columns.end) * 3];
        blend_row(row, &value_weights, &dot.colors);
    }
}

/// Returns the largest weight of the image, which is next to the pixel nearest to the centre.
fn peak_weight(nearest: [usize; 2], weight: impl Fn(usize, usize) -> f32) -> f32 {
    let around = |i: usize| i.saturating_sub(1)..(i + 2).min(FRAME_SIZE);
    let mut peak = 0.0_f32;
    for y in around(nearest[1]) {
        for x in around(nearest[0]) {
            peak = peak.max(weight(x, y));
        }
    }
    peak
}

/// Returns the pixels whose squared distance from `center` is at most `reach_squared`, and perhaps one more on each side.
fn pixels_within(center: f32, reach_squared: f32) -> std::ops::Range<usize> {
    let reach = reach_squared.max(0.0).sqrt();
    let first = (center - reach).max(0.0) as usize;
    let end = (center + reach + 1.0).clamp(0.0, FRAME_SIZE as f32) as usize;
    first.min(end)..end
}

/// Blends colours over a row of pixels, one weight per value; truncates as the published renderer does.
///
/// Weights and colours are spread over the values of a pixel, so that several values can be blended at a time.
fn blend_row(row: &mut [u8], weights: &[f32; ROW_VALUES], colors: &[f32; ROW_VALUES]) {
    for ((value, &weight), &color) in row.iter_mut().zip(weights).zip(colors) {
        *value = truncate(f32::from(*value) * (1.0 - weight) + color * weight);
    }
}

/// Truncates a number from 0 to below 256. A cast would do, but its checks keep it from being done several at a time.
#[inline]
fn truncate(value: f32) -> u8 {
    /// Adding this rounds to the nearest integer, which the low bits then hold.
    const ROUNDER: f32 = 8_388_608.0;
    let rounded = value + ROUNDER;
    let is_above = rounded - ROUNDER > value;
    (rounded.to_bits() as u8).wrapping_sub(u8::from(is_above))
}
