//! How a TwoRoom agent moves. Pure functions of position and action; the planners' true model.

use super::config::{
    BORDER_PX, DOOR_MARGIN_PX, PUSHBACK_PX, TwoRoomConfig, WALL_CENTER_PX, WORLD_SIZE_PX, WallAxis,
};

/// The lengths that collisions need, computed once from a configuration.
///
/// ```text
///        21        100  112  124        203      the default's numbers, in pixels of the agent's centre
///   ·─────┼──────────┼────┼────┼──────────┼─────·
///      free room   blocked unless in a door   free room
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// How the wall lies.
    pub axis: WallAxis,
    /// Smallest coordinate of the agent's centre, on both axes.
    pub room_low_px: f32,
    /// Largest coordinate of the agent's centre, on both axes.
    pub room_high_px: f32,
    /// Where the wall begins for an agent that comes from the low side. Double precision, as the published comparison.
    pub wall_low_px: f64,
    /// Where the wall begins for an agent that comes from the high side.
    pub wall_high_px: f64,
    /// Where the agent's centre may be along the wall while in it: first and last coordinate of each door, inclusive.
    pub passages_px: Vec<[f32; 2]>,
    /// Pixels per step at full action.
    pub speed_px: f32,
}

impl Geometry {
    /// Computes the lengths. Call [`TwoRoomConfig::check`] first for ranges.
    pub fn new(config: &TwoRoomConfig) -> Self {
        let radius = config.agent_radius_px;
        let reach = f64::from(config.wall_thickness_px / 2) + f64::from(radius);
        let passage = |center: u16, half_extent: u16| {
            let (center, reach) = (f32::from(center), f32::from(half_extent) + DOOR_MARGIN_PX);
            [center - reach, center + reach]
        };
        Geometry {
            axis: config.wall_axis,
            room_low_px: BORDER_PX + radius,
            room_high_px: WORLD_SIZE_PX - BORDER_PX - radius,
            wall_low_px: f64::from(WALL_CENTER_PX) - reach,
            wall_high_px: f64::from(WALL_CENTER_PX) + reach,
            passages_px: config.doors.iter().map(|d| passage(d.center_px, d.half_extent_px)).collect(),
            speed_px: config.speed_px,
        }
    }

    /// Whether an agent in the wall may have this coordinate along it.
    pub fn in_passage(&self, along_px: f32) -> bool {
        self.passages_px.iter().any(|&[first, last]| (first..=last).contains(&along_px))
    }

    /// Where `action` leads from `from`, as the published environment computes it.
    ///
    /// Only the end of the step meets the wall: what counts is on which side it starts and whether its *end* is in a
    /// door. A step may therefore cut a corner of the wall, and an agent that leaves a door's span inside of the wall
    /// is put back on the side that it is on. The order of operations and their precision are part of the contract.
    pub fn next_position(&self, from: [f32; 2], action: [f32; 2]) -> [f32; 2] {
        let mut to = self.next_position_without_wall(from, action);
        let across = self.axis.across();
        let in_passage = self.in_passage(to[self.axis.along()]);
        if from[across] < WALL_CENTER_PX {
            if f64::from(to[across]) > self.wall_low_px && !in_passage {
                to[across] = (self.wall_low_px - PUSHBACK_PX) as f32;
            }
        } else if f64::from(to[across]) < self.wall_high_px && !in_passage {
            to[across] = (self.wall_high_px + PUSHBACK_PX) as f32;
        }
        to
    }

    /// Where `action` would lead if there were no wall: the dynamics of a wall-blind model, a floor for planners.
    pub fn next_position_without_wall(&self, from: [f32; 2], action: [f32; 2]) -> [f32; 2] {
        [0, 1].map(|i| {
            let moved = from[i] + action[i].clamp(-1.0, 1.0) * self.speed_px;
            moved.max(self.room_low_px).min(self.room_high_px)
        })
    }
}

/// Distance between two positions, rounded as the published environment rounds it (the second square is fused).
pub fn distance_px(a: [f32; 2], b: [f32; 2]) -> f32 {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    dy.mul_add(dy, dx * dx).sqrt()
}
