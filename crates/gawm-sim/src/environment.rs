//! What every environment can do, and the types that pass its border.

use thiserror::Error;

/// A closed simulation with a task: it can be put into any state, stepped and looked at.
///
/// The life of one episode: [`reset`](Self::reset) (or [`set_state`](Self::set_state)), then [`step`](Self::step) until
/// [`Step::terminated`]. An environment never resets itself and sets no time limit; whoever drives it does.
/// Two environments with the same configuration that meet the same calls are equal to the bit.
pub trait Environment: Send {
    /// Returns what the environment is: widths, units, bounds and image size. Constant over its life.
    fn spec(&self) -> &EnvironmentSpec;

    /// Draws a start and a goal from `seed` alone and begins an episode there.
    fn reset(&mut self, seed: u64);

    /// Puts the system and its goal where `state` says and begins an episode there. Nothing is drawn or clamped.
    ///
    /// # Errors
    /// - [`EnvironmentError::Width`] when a vector has not the width of the spec.
    /// - [`EnvironmentError::NotFinite`] when a value is NaN or infinite.
    ///
    /// After an error the environment is as before.
    fn set_state(&mut self, state: &State) -> Result<(), EnvironmentError>;

    /// Acts for one control period. `action` has shape `[A]`; values beyond the bounds of the spec are clipped.
    ///
    /// # Errors
    /// As for [`set_state`](Self::set_state).
    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError>;

    /// Draws the current state into `frame`, whose size it sets.
    fn render(&self, frame: &mut Frame);

    /// Whether the task is solved in the current state.
    fn success(&self) -> bool;

    /// Returns the current system state and goal, exactly: `set_state` with it changes nothing.
    fn state(&self) -> State;

    /// Returns the action, shape `[A]`, that a solver with full knowledge of the environment takes in the current state.
    fn oracle(&self) -> Vec<f32>;
}

/// What an environment is.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentSpec {
    /// Name as on the command line, such as `two-room`.
    pub name: &'static str,
    /// What the agent is asked to do, as a sentence.
    pub task: &'static str,
    /// Steps per simulated second.
    pub control_hz: f64,
    /// One entry per action dimension; its length is `A`.
    pub action: Vec<Axis>,
    /// One entry per system state dimension; its length is `S`.
    pub state: Vec<Axis>,
    /// One entry per goal dimension; its length is `G`.
    pub goal: Vec<Axis>,
    /// Width of a rendered frame in pixels.
    pub frame_width: usize,
    /// Height of a rendered frame in pixels.
    pub frame_height: usize,
}

/// One dimension of an action, a state or a goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// Name, such as `x`.
    pub name: &'static str,
    /// Unit, such as `px`; empty for a number without one.
    pub unit: &'static str,
    /// Smallest value that has an effect of its own (actions) or that a reset draws (states and goals).
    pub low: f64,
    /// Largest such value.
    pub high: f64,
}

/// Where a system is and where it should be.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Shape `[S]`, in the units of [`EnvironmentSpec::state`].
    pub system: Vec<f64>,
    /// Shape `[G]`, in the units of [`EnvironmentSpec::goal`].
    pub goal: Vec<f64>,
}

/// What one step led to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Whether the task is solved after the step. Environments go on when stepped further.
    pub terminated: bool,
    /// Reward of the step, as the published environment gives it.
    pub reward: f64,
    /// Distance to the goal after the step, in the unit of the goal.
    pub distance: f64,
}

/// A rendered image.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Frame {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Shape `[height, width, 3]`, row-major RGB.
    pub rgb: Vec<u8>,
}

/// Why an environment refused an input.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum EnvironmentError {
    /// A vector has the wrong number of values.
    #[error("{what} has the wrong width: expected {expected}, got {got}")]
    Width {
        /// `action`, `system state` or `goal`.
        what: &'static str,
        /// Width in the spec.
        expected: usize,
        /// Width of the input.
        got: usize,
    },
    /// A value is NaN or infinite.
    #[error("{what}[{index}] is not usable: expected a finite number, got {got}")]
    NotFinite {
        /// `action`, `system state` or `goal`.
        what: &'static str,
        /// Position in the vector.
        index: usize,
        /// The value.
        got: f64,
    },
}

/// Checks that `values` are two finite numbers and returns them in single precision.
pub(crate) fn finite_pair(
    what: &'static str,
    values: impl ExactSizeIterator<Item = f64>,
) -> Result<[f32; 2], EnvironmentError> {
    let got = values.len();
    let mut pair = [0.0; 2];
    for (index, value) in values.enumerate() {
        let narrowed = value as f32;
        if !narrowed.is_finite() {
            return Err(EnvironmentError::NotFinite { what, index, got: value });
        }
        if let Some(slot) = pair.get_mut(index) {
            *slot = narrowed;
        }
    }
    if got != 2 {
        return Err(EnvironmentError::Width { what, expected: 2, got });
    }
    Ok(pair)
}
