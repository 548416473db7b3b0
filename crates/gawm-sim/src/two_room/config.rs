//! What can vary in TwoRoom, with the ranges of the published environment.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Side of the square world and of its image, in pixels. One pixel is one unit of length.
pub const WORLD_SIZE_PX: f32 = 224.0;
/// Distance of the inner edge of the border from the edge of the world.
pub const BORDER_PX: f32 = 14.0;
/// Where the wall's centre line lies, on the axis that it divides.
pub const WALL_CENTER_PX: f32 = 112.0;
/// The task is solved nearer to the goal than this.
pub const SUCCESS_RADIUS_PX: f64 = 16.0;
/// How far beyond each end of a door an agent's centre still passes.
pub const DOOR_MARGIN_PX: f32 = 1.75;
/// Where a blocked agent is put: this far before the line it may not cross.
pub const PUSHBACK_PX: f64 = 0.5;

/// How the wall lies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WallAxis {
    /// The wall is horizontal and divides y.
    Horizontal,
    /// The wall is vertical and divides x.
    #[default]
    Vertical,
}

impl WallAxis {
    /// Index of the coordinate that the wall divides: 0 for x, 1 for y.
    pub fn across(self) -> usize {
        match self {
            WallAxis::Vertical => 0,
            WallAxis::Horizontal => 1,
        }
    }

    /// Index of the coordinate that runs along the wall.
    pub fn along(self) -> usize {
        1 - self.across()
    }
}

/// A gap in the wall.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Door {
    /// Centre, along the wall, in pixels: 0 to 223.
    pub center_px: u16,
    /// Half of its width in pixels: 1 to 21.
    pub half_extent_px: u16,
}

/// Colours of what is drawn, RGB.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Colors {
    /// The agent's dot.
    pub agent: [u8; 3],
    /// The target's dot, where it is drawn.
    pub target: [u8; 3],
    /// The wall and the border.
    pub wall: [u8; 3],
    /// The doors.
    pub door: [u8; 3],
    /// Everything else.
    pub background: [u8; 3],
}

impl Default for Colors {
    fn default() -> Self {
        Colors {
            agent: [255, 0, 0],
            target: [0, 255, 0],
            wall: [0, 0, 0],
            door: [255, 255, 255],
            background: [255, 255, 255],
        }
    }
}

/// What can vary in TwoRoom. The default is the published task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TwoRoomConfig {
    /// How the wall lies.
    pub wall_axis: WallAxis,
    /// Thickness of the wall in pixels, 7 to 41; physics and drawing use half of it, rounded down, on each side.
    pub wall_thickness_px: u16,
    /// One to three doors; one of them must let the agent pass (half extent at least 1.1 radii).
    pub doors: Vec<Door>,
    /// Radius of the agent in pixels, 7 to 14: what collides, and the width of the drawn dot.
    pub agent_radius_px: f32,
    /// Pixels per step at full action, 1.75 to 10.5.
    pub speed_px: f32,
    /// Whether the target is drawn. The published task does not.
    pub render_target: bool,
    /// Width of the target's dot in pixels, 7 to 14.
    pub target_radius_px: f32,
    /// Colours.
    pub colors: Colors,
}

impl Default for TwoRoomConfig {
    fn default() -> Self {
        TwoRoomConfig {
            wall_axis: WallAxis::Vertical,
            wall_thickness_px: 10,
            doors: vec![Door { center_px: 49, half_extent_px: 14 }],
            agent_radius_px: 7.0,
            speed_px: 5.0,
            render_target: false,
            target_radius_px: 7.0,
            colors: Colors::default(),
        }
    }
}

/// Why a configuration is not a TwoRoom.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ConfigError {
    /// A value lies outside of its range.
    #[error("{field} is out of range: expected {low} to {high}, got {got}")]
    OutOfRange {
        /// Field of [`TwoRoomConfig`].
        field: &'static str,
        /// Smallest value allowed.
        low: f64,
        /// Largest value allowed.
        high: f64,
        /// The value.
        got: f64,
    },
    /// No door lets the agent pass.
    #[error("no door fits the agent: expected a half extent of at least {needed_px} px, got {widest_px} px")]
    NoFittingDoor {
        /// 1.1 times the radius of the agent.
        needed_px: f64,
        /// Half extent of the widest door.
        widest_px: u16,
    },
}

/// How much wider than the agent's radius a door's half extent must be for the agent to fit.
pub(crate) const DOOR_FIT: f64 = 1.1;

impl TwoRoomConfig {
    /// Checks all ranges.
    ///
    /// # Errors
    /// - [`ConfigError::OutOfRange`] names the first field outside of its range.
    /// - [`ConfigError::NoFittingDoor`] when every door is narrower than 1.1 radii of the agent.
    pub fn check(&self) -> Result<(), ConfigError> {
        let within = |field, got: f64, low: f64, high: f64| {
            if (low..=high).contains(&got) {
                Ok(())
            } else {
                Err(ConfigError::OutOfRange { field, low, high, got })
            }
        };
        within("wall_thickness_px", self.wall_thickness_px.into(), 7.0, 41.0)?;
        within("agent_radius_px", self.agent_radius_px.into(), 7.0, 14.0)?;
        within("target_radius_px", self.target_radius_px.into(), 7.0, 14.0)?;
        within("speed_px", self.speed_px.into(), 1.75, 10.5)?;
        within("number of doors", self.doors.len() as f64, 1.0, 3.0)?;
        for door in &self.doors {
            within("door center_px", door.center_px.into(), 0.0, 223.0)?;
            within("door half_extent_px", door.half_extent_px.into(), 1.0, 21.0)?;
        }
        let widest_px = self.doors.iter().map(|door| door.half_extent_px).max().unwrap_or(0);
        let needed_px = DOOR_FIT * f64::from(self.agent_radius_px);
        if f64::from(widest_px) < needed_px {
            return Err(ConfigError::NoFittingDoor { needed_px, widest_px });
        }
        Ok(())
    }
}
