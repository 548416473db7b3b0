//! Problems: from where to where, and how they are chosen.
//!
//! Three sources of pairs. [`reference_problems`] repeats the published choice over the episodes of a dataset, row by row.
//! [`draw_from_episodes`] draws from held-out episodes, [`draw_from_simulator`] from fresh episodes of the expert, of
//! which every seed gives others. Both draw uniformly over pairs and keep what passes a [`Filter`].

use std::sync::Arc;

use gawm_model::{Stream, permutation};
use gawm_sim::two_room::{ExpertConfig, TwoRoomExpert};
use gawm_sim::{Environment, Frame, State};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::numpy;
use crate::world::{TwoRoomWorld, World};

/// Rows between start and goal in the published evaluation (its slice of 25 rows ends at its last element).
pub const REFERENCE_OFFSET: usize = 24;
/// Rows that the published evaluation keeps free after a start.
const REFERENCE_MARGIN: usize = 25;
/// Longest episode of the expert, as published.
const MAX_EPISODE_STEPS: usize = 100;
/// Pairs that are looked at for each problem that is asked for, before giving up.
const MAX_TRIES_PER_PROBLEM: usize = 2000;

/// One problem: bring the system from a state to a goal that was seen later in the same episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Unique in its set, stable over runs: episode, start row and offset. Names the problem's random stream.
    pub id: String,
    /// The episode that both ends come from.
    pub episode: String,
    /// Row of the start.
    pub start_row: usize,
    /// Row of the goal.
    pub goal_row: usize,
    /// Start and goal of the environment.
    pub state: State,
    /// System state at the goal row: what the goal image shows.
    pub goal_system: Vec<f64>,
    /// Goal image of the dataset; without it the goal is rendered.
    pub goal_image: Option<Arc<Frame>>,
    /// Whether the start solves the task already.
    pub is_trivial: bool,
}

/// The rows of an episode that problems can be made of.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeStates {
    /// Stable identifier.
    pub id: String,
    /// System state of each row.
    pub rows: Vec<Vec<f64>>,
}

/// Which pairs may become problems.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Filter {
    /// All, also those whose start is a solution, as published.
    All,
    /// Those whose start is no solution.
    NonTrivial,
    /// Those that a straight line fails and the oracle solves within the budget.
    Wall,
}

/// What a set of problems is to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrawSpec {
    /// Name of the set, such as `tuning` or `final`: sets of other names have other episodes.
    pub name: String,
    /// Number of problems.
    pub count: usize,
    /// Rows from start to goal.
    pub offset: usize,
    /// Which pairs may become problems.
    pub filter: Filter,
    /// Steps that a solver has; decides what [`Filter::Wall`] means.
    pub budget_steps: usize,
    /// Seed of the choice.
    pub seed: u64,
}

/// Problems and how they came to be.
#[derive(Debug, Clone, PartialEq)]
pub struct ProblemSet {
    /// The problems.
    pub problems: Vec<Problem>,
    /// Pairs that were looked at.
    pub pairs_seen: usize,
    /// Most problems that share an episode.
    pub most_per_episode: usize,
    /// Where they come from, for reports.
    pub source: String,
}

/// Why there are no problems.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProblemError {
    /// Not enough pairs pass the filter.
    #[error(
        "not enough {filter} problems at +{offset}: expected {expected}, got {got} of {seen} pairs ({source_name})"
    )]
    TooFew {
        /// The filter.
        filter: &'static str,
        /// Rows from start to goal.
        offset: usize,
        /// Problems asked for.
        expected: usize,
        /// Problems found.
        got: usize,
        /// Pairs seen.
        seen: usize,
        /// What they were drawn from.
        source_name: String,
    },
    /// A state does not fit the environment.
    #[error("episode {episode} row {row}: {cause}")]
    State {
        /// The episode.
        episode: String,
        /// The row.
        row: usize,
        /// The cause.
        cause: gawm_sim::EnvironmentError,
    },
    /// The world has no straight line, so it has no wall set.
    #[error("this environment has no wall set")]
    NoWallSet,
}

impl Filter {
    /// Returns the name that reports show.
    pub fn name(self) -> &'static str {
        match self {
            Filter::All => "all",
            Filter::NonTrivial => "non-trivial",
            Filter::Wall => "wall",
        }
    }

    /// Whether a problem passes.
    ///
    /// # Errors
    /// [`ProblemError::NoWallSet`] where the world has no straight line.
    pub fn passes(
        self,
        world: &dyn World,
        environment: &mut dyn Environment,
        problem: &Problem,
        budget_steps: usize,
    ) -> Result<bool, ProblemError> {
        if self != Filter::All && problem.is_trivial {
            return Ok(false);
        }
        if self != Filter::Wall {
            return Ok(true);
        }
        let is_straight_solved = solves(environment, problem, budget_steps, |environment| {
            world.straight_line(&environment.state()).ok_or(ProblemError::NoWallSet)
        })?;
        Ok(!is_straight_solved
            && solves(environment, problem, budget_steps, |environment| Ok(environment.oracle()))?)
    }
}

/// Whether a solver reaches the goal within the budget.
fn solves(
    environment: &mut dyn Environment,
    problem: &Problem,
    budget_steps: usize,
    act: impl Fn(&dyn Environment) -> Result<Vec<f32>, ProblemError>,
) -> Result<bool, ProblemError> {
    let refuse =
        |cause| ProblemError::State { episode: problem.episode.clone(), row: problem.start_row, cause };
    environment.set_state(&problem.state).map_err(refuse)?;
    for _ in 0..budget_steps {
        let action = act(environment)?;
        if environment.step(&action).map_err(refuse)?.terminated {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Makes the problem of a pair of rows. The goal of the environment is the system state of the goal row.
fn problem(
    environment: &mut dyn Environment,
    episode: &EpisodeStates,
    start_row: usize,
    offset: usize,
) -> Result<Problem, ProblemError> {
    let goal_row = start_row + offset;
    let goal_system = episode.rows[goal_row].clone();
    let n_goal = environment.spec().goal.len();
    let goal = goal_system.iter().copied().take(n_goal).collect();
    let state = State { system: episode.rows[start_row].clone(), goal };
    environment.set_state(&state).map_err(|cause| ProblemError::State {
        episode: episode.id.clone(),
        row: start_row,
        cause,
    })?;
    Ok(Problem {
        id: format!("{}/{start_row}+{offset}", episode.id),
        episode: episode.id.clone(),
        start_row,
        goal_row,
        state,
        goal_system,
        goal_image: None,
        is_trivial: environment.success(),
    })
}

/// Chooses the published problems: numpy's pairs over all rows of all episodes, in the order of the dataset.
///
/// Valid rows are those with at least 25 rows after them; the last valid one is never chosen, as published.
///
/// # Errors
/// [`ProblemError::TooFew`] when there are fewer valid rows, [`ProblemError::State`] for states that are not finite.
pub fn reference_problems(
    world: &dyn World,
    episodes: &[EpisodeStates],
    count: usize,
    seed: u64,
) -> Result<ProblemSet, ProblemError> {
    let starts = |episode: &EpisodeStates| episode.rows.len().saturating_sub(REFERENCE_MARGIN);
    let valid: Vec<(usize, usize)> = episodes
        .iter()
        .enumerate()
        .flat_map(|(index, episode)| (0..starts(episode)).map(move |row| (index, row)))
        .collect();
    let source = format!("the published choice (seed {seed}) over {} episodes", episodes.len());
    if valid.len() <= count {
        return Err(ProblemError::TooFew {
            filter: Filter::All.name(),
            offset: REFERENCE_OFFSET,
            expected: count,
            got: valid.len(),
            seen: valid.len(),
            source_name: source,
        });
    }
    let mut environment = world.environment();
    let n = u32::try_from(valid.len() - 1).unwrap_or(u32::MAX);
    let chosen = numpy::sorted_choice(seed, n, u32::try_from(count).unwrap_or(u32::MAX));
    let problems = chosen
        .into_iter()
        .map(|index| {
            let (episode, row) = valid[index as usize];
            problem(environment.as_mut(), &episodes[episode], row, REFERENCE_OFFSET)
        })
        .collect::<Result<Vec<_>, _>>()?;
    let most_per_episode = most_per_episode(&problems);
    Ok(ProblemSet { problems, pairs_seen: count, most_per_episode, source })
}

fn most_per_episode(problems: &[Problem]) -> usize {
    let mut names: Vec<&str> = problems.iter().map(|problem| problem.episode.as_str()).collect();
    names.sort_unstable();
    names.chunk_by(|a, b| a == b).map(<[&str]>::len).max().unwrap_or(0)
}

/// Draws problems from episodes, uniformly over pairs, as evenly over episodes as the count allows.
///
/// # Errors
/// [`ProblemError::TooFew`] when too few pairs pass the filter.
pub fn draw_from_episodes(
    world: &dyn World,
    episodes: &[EpisodeStates],
    spec: &DrawSpec,
) -> Result<ProblemSet, ProblemError> {
    let pairs: Vec<(usize, usize)> = episodes
        .iter()
        .enumerate()
        .flat_map(|(index, episode)| {
            (0..episode.rows.len().saturating_sub(spec.offset)).map(move |row| (index, row))
        })
        .collect();
    let mut stream = Stream::new(spec.seed, &format!("problems/{}/{}", spec.name, spec.filter.name()), 0);
    let order = permutation(&mut stream, u32::try_from(pairs.len()).unwrap_or(u32::MAX));
    let mut environment = world.environment();
    let (mut seen, mut problems) = (0, Vec::new());
    let mut taken = vec![0usize; episodes.len()];
    // Later rounds allow one problem more per episode; a pair is looked at in the round in which its turn comes.
    let mut waiting: Vec<(usize, usize)> = order.into_iter().map(|index| pairs[index as usize]).collect();
    let mut limit = 1;
    while problems.len() < spec.count && !waiting.is_empty() {
        let mut later = Vec::new();
        for (episode, row) in waiting {
            if problems.len() == spec.count {
                break;
            }
            if taken[episode] == limit {
                later.push((episode, row));
                continue;
            }
            seen += 1;
            let candidate = problem(environment.as_mut(), &episodes[episode], row, spec.offset)?;
            if spec.filter.passes(world, environment.as_mut(), &candidate, spec.budget_steps)? {
                taken[episode] += 1;
                problems.push(candidate);
            }
        }
        waiting = later;
        limit += 1;
    }
    let source = format!("held-out episodes of the dataset ({}, seed {})", episodes.len(), spec.seed);
    finish(spec, problems, seen, source)
}

fn finish(
    spec: &DrawSpec,
    problems: Vec<Problem>,
    seen: usize,
    source: String,
) -> Result<ProblemSet, ProblemError> {
    if problems.len() < spec.count {
        return Err(ProblemError::TooFew {
            filter: spec.filter.name(),
            offset: spec.offset,
            expected: spec.count,
            got: problems.len(),
            seen,
            source_name: source,
        });
    }
    let most_per_episode = most_per_episode(&problems);
    Ok(ProblemSet { problems, pairs_seen: seen, most_per_episode, source })
}

/// Draws problems from fresh episodes of the published expert, uniformly over pairs, one per episode.
///
/// Episode k of a set depends on seed, name and k alone; no other set shares one, and no dataset unless it was collected
/// with the same 64-bit seeds.
///
/// # Errors
/// [`ProblemError::TooFew`] when too few pairs pass the filter.
pub fn draw_from_simulator(world: &TwoRoomWorld, spec: &DrawSpec) -> Result<ProblemSet, ProblemError> {
    let mut environment = world.environment();
    let (mut seen, mut problems) = (0, Vec::new());
    let tries = spec.count.saturating_mul(MAX_TRIES_PER_PROBLEM);
    for index in 0..tries as u64 {
        if problems.len() == spec.count {
            break;
        }
        // A start row of the longest episode: those that this one has not are drawn anew with the next episode, so that
        // every pair of every episode is equally likely.
        let mut stream = Stream::new(spec.seed, &format!("pool/{}/{}", spec.name, spec.filter.name()), index);
        let seed = u64::from(stream.next_u32()) << 32 | u64::from(stream.next_u32());
        let row = stream.below(MAX_EPISODE_STEPS as u32 + 1) as usize;
        let episode = expert_episode(world, seed, format!("{}-{index}", spec.name));
        if row + spec.offset >= episode.rows.len() {
            continue;
        }
        seen += 1;
        let candidate = problem(environment.as_mut(), &episode, row, spec.offset)?;
        if spec.filter.passes(world, environment.as_mut(), &candidate, spec.budget_steps)? {
            problems.push(candidate);
        }
    }
    let source = format!("fresh episodes of the expert (set {:?}, seed {})", spec.name, spec.seed);
    finish(spec, problems, seen, source)
}

/// Lets the published expert act from a reset until it arrives or 100 steps have passed.
pub fn expert_episode(world: &TwoRoomWorld, seed: u64, id: String) -> EpisodeStates {
    let mut room = world.room().clone();
    room.reset(seed);
    let mut expert = TwoRoomExpert::new(ExpertConfig::default(), seed);
    let mut rows = vec![room.state().system];
    for _ in 0..MAX_EPISODE_STEPS {
        let action = expert.act(room.config(), room.agent(), room.target());
        let step = room.advance(action);
        rows.push(room.state().system);
        if step.terminated {
            break;
        }
    }
    EpisodeStates { id, rows }
}

#[cfg(test)]
mod tests;
