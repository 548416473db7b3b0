//! The published data collector: towards the nearest fitting door, then towards the target, with noise.

use super::config::{DOOR_FIT, TwoRoomConfig, WALL_CENTER_PX};
use crate::rng::{Rng, Stream};

/// How the expert acts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExpertConfig {
    /// Standard deviation of the noise on each action component, before clipping. Published collection: 2.
    pub action_noise: f64,
    /// Probability that an action repeats the one before. Published collection: 0.05.
    ///
    /// The published class takes the same number but never remembers an action, so there it has no effect; 0 is its
    /// behaviour.
    pub action_repeat: f64,
    /// Distance from a door's centre at which the expert turns to the target, in pixels. Published: 10.5.
    pub door_reach_px: f32,
}

impl Default for ExpertConfig {
    fn default() -> Self {
        ExpertConfig { action_noise: 2.0, action_repeat: 0.05, door_reach_px: 10.5 }
    }
}

/// The expert of one episode.
#[derive(Clone, Debug)]
pub struct TwoRoomExpert {
    config: ExpertConfig,
    rng: Rng,
    last_action: Option<[f32; 2]>,
}

impl TwoRoomExpert {
    /// Starts an expert whose noise depends on `seed` alone.
    pub fn new(config: ExpertConfig, seed: u64) -> Self {
        TwoRoomExpert { config, rng: Rng::new(seed, Stream::Policy), last_action: None }
    }

    /// Chooses the next action, each component in [-1, 1].
    ///
    /// Draws the same count of random numbers at every step, so that a change of one option leaves the others' draws.
    pub fn act(&mut self, room: &TwoRoomConfig, agent: [f32; 2], target: [f32; 2]) -> [f32; 2] {
        let direction = expert_direction(room, self.config.door_reach_px, agent, target);
        let noise = [self.rng.normal(), self.rng.normal()];
        let repeats = self.rng.unit() < self.config.action_repeat;
        let fresh = [0, 1].map(|i| {
            let noisy = direction[i] + (self.config.action_noise * noise[i]) as f32;
            noisy.clamp(-1.0, 1.0)
        });
        let action = if repeats { self.last_action.unwrap_or(fresh) } else { fresh };
        self.last_action = Some(action);
        action
    }
}

/// The expert's direction before noise: a vector of length 1, or 0 at the waypoint itself.
pub fn expert_direction(
    room: &TwoRoomConfig,
    door_reach_px: f32,
    agent: [f32; 2],
    target: [f32; 2],
) -> [f32; 2] {
    let across = room.wall_axis.across();
    let is_beyond = |p: [f32; 2]| p[across] > WALL_CENTER_PX;
    let waypoint = if is_beyond(agent) == is_beyond(target) {
        target
    } else {
        match nearest_fitting_door(room, agent) {
            Some(door) if norm(door, agent) > door_reach_px => door,
            Some(_) => target,
            None => on_wall(room, target[room.wall_axis.along()]),
        }
    };
    unit_direction(agent, waypoint)
}

/// The vector of length 1 from one position to another, or 0 when they coincide.
pub fn unit_direction(from: [f32; 2], to: [f32; 2]) -> [f32; 2] {
    let norm = norm(from, to);
    if norm > 1e-8 { [0, 1].map(|i| (to[i] - from[i]) / norm) } else { [0.0; 2] }
}

/// Distance, rounded as the published expert rounds it: unlike the environment's, without a fused operation.
fn norm(a: [f32; 2], b: [f32; 2]) -> f32 {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    (dx * dx + dy * dy).sqrt()
}

fn on_wall(room: &TwoRoomConfig, along_px: f32) -> [f32; 2] {
    let mut at = [WALL_CENTER_PX; 2];
    at[room.wall_axis.along()] = along_px;
    at
}

/// The centre of the nearest door whose half extent is at least 1.1 radii of the agent.
fn nearest_fitting_door(room: &TwoRoomConfig, agent: [f32; 2]) -> Option<[f32; 2]> {
    let needed_px = DOOR_FIT * f64::from(room.agent_radius_px);
    room.doors
        .iter()
        .filter(|door| f64::from(door.half_extent_px) >= needed_px)
        .map(|door| on_wall(room, f32::from(door.center_px)))
        .min_by(|a, b| norm(*a, agent).total_cmp(&norm(*b, agent)))
}
