//! The numbers that a quickstart ends with.

use gawm_eval::suite::{PlanReport, Rate, SetResult, Solver};
use serde::Serialize;

use crate::pipeline::Outcome;

/// `summary.json`: success rates are fractions of the problems of a set, solved after any step.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// The model on problems whose start is no solution.
    pub success: f64,
    /// Doing nothing, on the same problems.
    pub floor_noop: f64,
    /// Random actions, on the same problems.
    pub floor_random: f64,
    /// A straight line that ignores the wall, on the same problems.
    pub floor_straight: f64,
    /// The model on problems that a straight line fails.
    pub wall_success: f64,
    /// The same search over the true dynamics without the wall, on the same problems.
    pub wall_floor_blind: f64,
    /// Problems of both sets together.
    pub problems: usize,
    /// Wall time of all steps, seconds; of the run that did it, for steps that were up to date.
    pub seconds: f64,
    /// What the two sets say about the model, as a sentence.
    pub verdict: String,
}

impl Summary {
    /// Takes the numbers from the results of planning.
    ///
    /// # Errors
    ///
    /// The name of what the results lack.
    pub fn of(plan: &PlanReport, outcome: &Outcome) -> Result<Summary, String> {
        let set = |name: &str| {
            plan.sets.iter().find(|set| set.name == name).ok_or_else(|| format!("expected a set {name:?}"))
        };
        let rate = |set: &SetResult, solver: Solver| {
            let result = set.solver(solver);
            result
                .map(|result| result.any)
                .ok_or_else(|| format!("expected {} in {:?}", solver.name(), set.name))
        };
        let (plain, wall) = (set("non-trivial")?, set("wall")?);
        let (model, blind) = (rate(wall, Solver::Model)?, rate(wall, Solver::WallBlind)?);
        Ok(Summary {
            success: rate(plain, Solver::Model)?.rate,
            floor_noop: rate(plain, Solver::NoOp)?.rate,
            floor_random: rate(plain, Solver::Random)?.rate,
            floor_straight: rate(plain, Solver::StraightLine)?.rate,
            wall_success: model.rate,
            wall_floor_blind: blind.rate,
            problems: plain.n + wall.n,
            seconds: outcome.steps.iter().map(|step| step.seconds).sum(),
            verdict: verdict(model, blind, rate(wall, Solver::Untrained)?),
        })
    }
}

/// Says what the wall set shows: it is the one that a planner blind for the wall cannot solve by luck alone.
fn verdict(model: Rate, blind: Rate, untrained: Rate) -> String {
    let percent = |rate: Rate| {
        let (low, high) = (100.0 * rate.interval.low, 100.0 * rate.interval.high);
        format!("{:.0} % [{low:.0}, {high:.0}]", 100.0 * rate.rate)
    };
    let judgement = if model.interval.low > blind.interval.high
        && model.interval.low > untrained.interval.high
    {
        "The model knows the wall: it beats the search that is blind for it and the untrained encoder, and their 95 % intervals do not touch."
    } else if model.interval.low > untrained.interval.high {
        "The model learned to move, but that it knows the wall is not shown: its interval touches that of the search that is blind for the wall."
    } else {
        "The model is not shown to know more than an untrained encoder."
    };
    format!(
        "{judgement} On the {} problems that need the door: model {}, wall-blind search {}, untrained {}.",
        model.n,
        percent(model),
        percent(blind),
        percent(untrained)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(successes: usize) -> Rate {
        Rate::of((0..100).map(|index| index < successes))
    }

    #[test]
    fn the_verdict_claims_only_what_intervals_show() {
        assert!(verdict(rate(70), rate(35), rate(10)).starts_with("The model knows the wall"));
        assert!(verdict(rate(45), rate(35), rate(10)).contains("not shown: its interval touches"));
        assert!(verdict(rate(15), rate(35), rate(10)).starts_with("The model is not shown"));
        assert!(verdict(rate(70), rate(35), rate(10)).contains("model 70 % [60, 78]"));
    }
}
