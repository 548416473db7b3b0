//! What evaluation knows about an environment: how to make one, and the solvers that need no learning.

use gawm_sim::two_room::{Geometry, straight_line_action};
use gawm_sim::{Environment, State, TwoRoom, TwoRoomConfig};

/// A task with a simulator: the source of environments, and what floors and ceilings need.
pub trait World: Sync {
    /// Makes an environment. All of them are equal.
    fn environment(&self) -> Box<dyn Environment>;

    /// Returns the action of a solver that goes straight to the goal, ignoring obstacles; `None` without such a notion.
    fn straight_line(&self, state: &State) -> Option<Vec<f32>>;

    /// Returns the physics of a TwoRoom, for planning over known dynamics; `None` for other environments.
    fn geometry(&self) -> Option<&Geometry>;
}

/// TwoRoom, as published unless configured.
#[derive(Debug, Clone)]
pub struct TwoRoomWorld {
    room: TwoRoom,
}

impl TwoRoomWorld {
    /// Makes the world of a configuration.
    ///
    /// # Errors
    /// A value lies outside of the published range.
    pub fn new(config: TwoRoomConfig) -> Result<Self, gawm_sim::two_room::ConfigError> {
        Ok(TwoRoomWorld { room: TwoRoom::new(config)? })
    }

    /// Returns the environment that all are copies of.
    pub fn room(&self) -> &TwoRoom {
        &self.room
    }
}

impl World for TwoRoomWorld {
    fn environment(&self) -> Box<dyn Environment> {
        Box::new(self.room.clone())
    }

    fn straight_line(&self, state: &State) -> Option<Vec<f32>> {
        let pair = |values: &[f64]| Some([*values.first()? as f32, *values.get(1)? as f32]);
        let action = straight_line_action(self.room.geometry(), pair(&state.system)?, pair(&state.goal)?);
        Some(action.to_vec())
    }

    fn geometry(&self) -> Option<&Geometry> {
        Some(self.room.geometry())
    }
}
