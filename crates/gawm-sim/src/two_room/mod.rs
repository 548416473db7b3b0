//! TwoRoom: an agent, a dot, goes to a target that may lie behind a wall with doors.
//!
//! Native and equal to the published environment (`swm/TwoRoom-v1` of stable-worldmodel 0.0.6) step by step and pixel
//! by pixel: `fixtures/tworoom` holds what that one does. Only the draws of [`reset`](crate::Environment::reset) are
//! our own. Positions are (x, y) in pixels, x to the right, y down; one step is a tenth of a second.

mod config;
mod dynamics;
mod expert;
mod oracle;
mod render;

pub use config::{
    BORDER_PX, Colors, ConfigError, DOOR_MARGIN_PX, Door, PUSHBACK_PX, SUCCESS_RADIUS_PX, TwoRoomConfig,
    WALL_CENTER_PX, WORLD_SIZE_PX, WallAxis,
};
pub use dynamics::{Geometry, distance_px};
pub use expert::{ExpertConfig, TwoRoomExpert, expert_direction, unit_direction};
pub use oracle::{oracle_action, straight_line_action};
pub use render::{FRAME_SIZE, Renderer};

use crate::environment::{
    Axis, Environment, EnvironmentError, EnvironmentSpec, Frame, State, Step, finite_pair,
};
use crate::rng::{Rng, Stream};

/// Steps per simulated second.
const CONTROL_HZ: f64 = 10.0;

/// The environment.
///
/// ```
/// use gawm_sim::{Environment, Frame, TwoRoom, TwoRoomConfig};
///
/// let mut room = TwoRoom::new(TwoRoomConfig::default())?;
/// room.reset(7);
/// let mut steps = 0;
/// while !room.success() {
///     room.step(&room.oracle())?;
///     steps += 1;
/// }
/// let mut frame = Frame::default();
/// room.render(&mut frame);
/// assert_eq!(frame.rgb.len(), 224 * 224 * 3);
/// assert!(steps < 100);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct TwoRoom {
    config: TwoRoomConfig,
    geometry: Geometry,
    renderer: Renderer,
    spec: EnvironmentSpec,
    agent: [f32; 2],
    target: [f32; 2],
}

impl TwoRoom {
    /// Builds the environment, with the agent left of the wall and the target right of it.
    ///
    /// # Errors
    /// [`ConfigError`] when a value lies outside of the published range.
    pub fn new(config: TwoRoomConfig) -> Result<Self, ConfigError> {
        config.check()?;
        Ok(TwoRoom {
            geometry: Geometry::new(&config),
            renderer: Renderer::new(&config),
            spec: spec(),
            agent: [60.0, 112.0],
            target: [164.0, 112.0],
            config,
        })
    }

    /// Returns the configuration.
    pub fn config(&self) -> &TwoRoomConfig {
        &self.config
    }

    /// Returns the lengths of its physics: the true dynamics without the environment around them.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Returns what draws its frames.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// Returns the agent's position.
    pub fn agent(&self) -> [f32; 2] {
        self.agent
    }

    /// Returns the target's position.
    pub fn target(&self) -> [f32; 2] {
        self.target
    }

    /// Steps without checks or allocation. A component that is not finite makes the position so.
    pub fn advance(&mut self, action: [f32; 2]) -> Step {
        self.agent = self.geometry.next_position(self.agent, action);
        let distance = f64::from(distance_px(self.agent, self.target));
        Step { terminated: distance < SUCCESS_RADIUS_PX, reward: 0.0, distance }
    }
}

impl Environment for TwoRoom {
    fn spec(&self) -> &EnvironmentSpec {
        &self.spec
    }

    /// Agent and target are uniform over [14, 209] squared; the agent is drawn again while it stands in the wall, doors
    /// included. The target may be anywhere, in the wall too.
    fn reset(&mut self, seed: u64) {
        let mut rng = Rng::new(seed, Stream::Reset);
        let (low, high) = (f64::from(BORDER_PX), f64::from(WORLD_SIZE_PX - BORDER_PX - 1.0));
        let mut draw = || [0, 1].map(|_| rng.uniform(low, high) as f32);
        let across = self.config.wall_axis.across();
        self.agent = loop {
            let agent = draw();
            let across_px = f64::from(agent[across]);
            if across_px < self.geometry.wall_low_px || across_px > self.geometry.wall_high_px {
                break agent;
            }
        };
        self.target = draw();
    }

    fn set_state(&mut self, state: &State) -> Result<(), EnvironmentError> {
        let agent = finite_pair("system state", state.system.iter().copied())?;
        let target = finite_pair("goal", state.goal.iter().copied())?;
        (self.agent, self.target) = (agent, target);
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        let action = finite_pair("action", action.iter().map(|&a| f64::from(a)))?;
        Ok(self.advance(action))
    }

    fn render(&self, frame: &mut Frame) {
        self.renderer.render(self.agent, self.target, frame);
    }

    fn success(&self) -> bool {
        f64::from(distance_px(self.agent, self.target)) < SUCCESS_RADIUS_PX
    }

    fn state(&self) -> State {
        State { system: self.agent.map(f64::from).to_vec(), goal: self.target.map(f64::from).to_vec() }
    }

    fn oracle(&self) -> Vec<f32> {
        oracle_action(&self.geometry, self.agent, self.target).to_vec()
    }
}

fn spec() -> EnvironmentSpec {
    let axes = |unit, low, high| ["x", "y"].map(|name| Axis { name, unit, low, high }).to_vec();
    let (low, high) = (f64::from(BORDER_PX), f64::from(WORLD_SIZE_PX - BORDER_PX - 1.0));
    EnvironmentSpec {
        name: "two-room",
        task: "go to the target",
        control_hz: CONTROL_HZ,
        action: axes("", -1.0, 1.0),
        state: axes("px", low, high),
        goal: axes("px", low, high),
        frame_width: FRAME_SIZE,
        frame_height: FRAME_SIZE,
    }
}
