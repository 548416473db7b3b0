//! What a run learned, and what it did not.

use std::fmt::Write;

use crate::metrics::{Record, ValidationRecord};

/// A skill below this is no better than the baseline.
const NOTHING_LEARNED: f64 = 0.02;
/// A skill below this is little.
const LITTLE_LEARNED: f64 = 0.2;
/// Most validations that the table of a run shows.
const MAX_ROWS: usize = 12;

/// Sums a run up from its metrics: the curve of validations, the best one beside its baselines, what did not learn.
pub fn summary(records: &[Record], best_steps: Option<u64>) -> String {
    let validations: Vec<&ValidationRecord> = records
        .iter()
        .filter_map(|record| match record {
            Record::Validation(validation) => Some(validation),
            Record::Train(_) => None,
        })
        .collect();
    let mut text = String::new();
    let Some(last) = validations.last() else {
        return "no validation: nothing can be said about what was learned\n".to_owned();
    };
    curves(&mut text, &validations);
    let best = validations.iter().find(|validation| Some(validation.step) == best_steps).unwrap_or(last);
    judge(&mut text, best);
    if let Some(reason) = &last.collapse {
        writeln!(text, "\nALARM: the latents have collapsed: {reason}").ok();
    }
    text
}

/// One line per validation, evenly chosen if there are many.
fn curves(text: &mut String, validations: &[&ValidationRecord]) {
    let terms: Vec<&str> = validations[0].terms.iter().map(|term| term.term.as_str()).collect();
    write!(text, "{:>8}", "steps").ok();
    for term in &terms {
        write!(text, " {term:>18} {:>9}", "baseline").ok();
    }
    writeln!(text, " {:>7} {:>8} {:>7} {:>6} {:>8}", "skill", "shuffled", "std z", "rank", "score").ok();
    let stride = validations.len().div_ceil(MAX_ROWS);
    let is_shown = |index: usize| (validations.len() - 1 - index).is_multiple_of(stride);
    for (_, validation) in validations.iter().enumerate().filter(|(index, _)| is_shown(*index)) {
        write!(text, "{:>8}", validation.step).ok();
        for term in &validation.terms {
            let baseline = term.baseline.as_ref().map_or("-".to_owned(), |b| format!("{:.4}", b.value));
            write!(text, " {:>18.4} {baseline:>9}", term.value).ok();
        }
        writeln!(
            text,
            " {:>7.3} {:>8.3} {:>7.3} {:>6.1} {:>8.4}{}",
            validation.skill,
            validation.skill_shuffled_actions,
            validation.latent_std,
            validation.effective_rank,
            validation.score,
            if validation.is_best { " *" } else { "" }
        )
        .ok();
    }
}

/// The verdict on each term and each dim.
fn judge(text: &mut String, best: &ValidationRecord) {
    writeln!(text, "\nbest validation: after {} steps, score {:.4}", best.step, best.score).ok();
    let verdict = |skill: f64| match skill {
        skill if skill < NOTHING_LEARNED => "NOT LEARNED: no better than its baseline",
        skill if skill < LITTLE_LEARNED => "little learned",
        _ => "learned",
    };
    let mut line = |name: &str, value: f64, baseline: &str, baseline_value: f64, skill: f64| {
        writeln!(
            text,
            "  {name:<34} {value:>9.4}  {baseline:<8} {baseline_value:>9.4}  skill {skill:>7.3}  {}",
            verdict(skill)
        )
        .ok();
    };
    for term in &best.terms {
        if let Some(baseline) = &term.baseline {
            line(&term.term, term.value, &baseline.name, baseline.value, baseline.skill);
        }
    }
    for (kind, dims) in [("state", &best.states), ("action", &best.actions)] {
        for dim in dims {
            line(&format!("{kind} {}", dim.name), dim.error, "constant", dim.variance, dim.skill);
        }
    }
    writeln!(
        text,
        "  prediction over variance of z {:.4}; drop of skill under shuffled actions {:.3}{}",
        best.prediction_over_variance,
        best.skill_drop,
        if best.skill_drop < NOTHING_LEARNED {
            " (NOT LEARNED: actions do not matter to the prediction)"
        } else {
            ""
        }
    )
    .ok();
}
