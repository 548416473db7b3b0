//! Standardisation of the encoded columns of a mix, and what only a pass over all rows can say.

use gawm_schema::batch::{EncodedFeature, StandardisedDimInfo};
use gawm_schema::{ContentHash, EncodedDim};

use crate::config::Compat;
use crate::source::{Encoded, Source};

/// Smallest scale of a state under `compat = "reference"`, as published.
const REFERENCE_MIN_SCALE: f64 = 1e-6;

/// Mean and scale of one dim.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Affine {
    pub(crate) mean: f64,
    pub(crate) scale: f64,
    pub(crate) is_constant: bool,
}

/// The standardisation of one column, common to all datasets of a mix.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Fit {
    pub(crate) dims: Vec<Affine>,
    fitted_on: String,
    fitted_hash: ContentHash,
}

/// Which column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    State,
    Action,
}

/// Values of one column of a dataset with their validity.
struct Values<'a> {
    width: usize,
    values: &'a [f32],
    valid: &'a [u8],
    /// Validity per value, or per row.
    is_valid_per_value: bool,
}

impl Values<'_> {
    fn is_valid(&self, row: usize, dim: usize) -> bool {
        let at = if self.is_valid_per_value { row * self.width + dim } else { row };
        self.valid[at] != 0
    }

    fn get(&self, row: usize, dim: usize) -> f64 {
        f64::from(self.values[row * self.width + dim])
    }
}

fn values(source: &Source, part: Part) -> Values<'_> {
    let rows = &source.rows;
    match part {
        Part::State => Values {
            width: source.state.dims.len(),
            values: &rows.states,
            valid: &rows.state_valid,
            is_valid_per_value: true,
        },
        Part::Action => Values {
            width: source.action.dims.len(),
            values: &rows.actions,
            valid: &rows.action_valid,
            is_valid_per_value: false,
        },
    }
}

fn encoded(source: &Source, part: Part) -> &Encoded {
    match part {
        Part::State => &source.state,
        Part::Action => &source.action,
    }
}

/// Returns the standardisation that applies to all sources.
///
/// Repaired: what the datasets were fitted with on their training episodes; several are pooled by their numbers of rows.
/// Reference: mean and std with ddof 1 over all rows of all datasets.
pub(crate) fn fit(sources: &[Source], part: Part, compat: Compat) -> Fit {
    let stored: Option<Vec<_>> = sources.iter().map(|s| encoded(s, part).standardisation.as_ref()).collect();
    match (compat, stored) {
        (Compat::Repaired, Some(stored)) if !stored.is_empty() => {
            let width = stored[0].dims.len();
            let dims = (0..width)
                .map(|dim| {
                    pool(stored.iter().map(|s| {
                        let d = &s.dims[dim];
                        let std = if d.is_constant { 0.0 } else { d.scale };
                        (s.fitted_on.frames as f64, d.mean, std, d.is_standardised, d.scale)
                    }))
                })
                .collect();
            let hashes: String = stored.iter().map(|s| s.fitted_on.hash.to_string()).collect();
            let fitted_hash = match stored.as_slice() {
                [one] => one.fitted_on.hash,
                _ => ContentHash::of(hashes.as_bytes()),
            };
            Fit { dims, fitted_on: stored[0].fitted_on.episodes_of.clone(), fitted_hash }
        }
        _ => {
            let dims = &encoded(&sources[0], part).dims;
            let hashes: String = sources.iter().map(|s| s.content_hash.to_string()).collect();
            Fit {
                dims: dims.iter().enumerate().map(|(i, dim)| reference(sources, part, i, dim)).collect(),
                fitted_on: "reference".to_owned(),
                fitted_hash: ContentHash::of(hashes.as_bytes()),
            }
        }
    }
}

/// Pools (rows, mean, std, whether standardised, stored scale) of several datasets.
fn pool(parts: impl Iterator<Item = (f64, f64, f64, bool, f64)> + Clone) -> Affine {
    let first = parts.clone().next().unwrap_or((0.0, 0.0, 0.0, false, 1.0));
    if !first.3 {
        return Affine { mean: 0.0, scale: 1.0, is_constant: false };
    }
    if parts.clone().count() == 1 {
        // As stored, to the bit.
        return Affine { mean: first.1, scale: first.4, is_constant: first.2 == 0.0 };
    }
    let rows: f64 = parts.clone().map(|p| p.0).sum();
    if rows == 0.0 {
        return Affine { mean: 0.0, scale: 1.0, is_constant: true };
    }
    let mean = parts.clone().map(|(n, mean, ..)| n * mean).sum::<f64>() / rows;
    let variance = parts.map(|(n, m, std, ..)| n * (std * std + (m - mean).powi(2))).sum::<f64>() / rows;
    affine(mean, variance.sqrt())
}

fn reference(sources: &[Source], part: Part, dim: usize, encoded: &EncodedDim) -> Affine {
    if !encoded.is_standardised {
        return Affine { mean: 0.0, scale: 1.0, is_constant: false };
    }
    let (n, mean, squares) = moments(sources, part, dim, |_| true);
    let std = if n > 1 { (squares / (n - 1) as f64).sqrt() } else { 0.0 };
    let floor = if part == Part::State { REFERENCE_MIN_SCALE } else { 0.0 };
    affine(mean, std.max(floor))
}

fn affine(mean: f64, std: f64) -> Affine {
    let is_constant = !std.is_normal();
    Affine { mean, scale: if is_constant { 1.0 } else { std }, is_constant }
}

/// Returns count, mean and sum of squared deviations of the valid values in the rows that are wanted, in two passes.
fn moments(
    sources: &[Source],
    part: Part,
    dim: usize,
    is_wanted: impl Fn(&crate::source::Episode) -> bool,
) -> (u64, f64, f64) {
    let each = |visit: &mut dyn FnMut(f64)| {
        for source in sources {
            let values = values(source, part);
            for episode in source.episodes.iter().filter(|e| is_wanted(e)) {
                let first = episode.first_row as usize;
                for row in first..first + episode.rows {
                    if values.is_valid(row, dim) {
                        visit(values.get(row, dim));
                    }
                }
            }
        }
    };
    let (mut n, mut sum, mut squares) = (0_u64, 0.0, 0.0);
    each(&mut |value| {
        n += 1;
        sum += value;
    });
    let mean = if n > 0 { sum / n as f64 } else { 0.0 };
    each(&mut |value| squares += (value - mean).powi(2));
    (n, mean, squares)
}

/// Standardises the values of all sources in place; what is not valid becomes 0, the mean.
pub(crate) fn apply(sources: &mut [Source], part: Part, fit: &Fit) {
    let width = fit.dims.len();
    for source in sources {
        let rows = &mut source.rows;
        let (values, valid, per_value) = match part {
            Part::State => (&mut rows.states, &rows.state_valid, true),
            Part::Action => (&mut rows.actions, &rows.action_valid, false),
        };
        for (at, value) in values.iter_mut().enumerate() {
            let Affine { mean, scale, .. } = fit.dims[at % width];
            let is_valid = valid[if per_value { at } else { at / width }] != 0;
            *value = if is_valid { ((f64::from(*value) - mean) / scale) as f32 } else { 0.0 };
        }
    }
}

/// Describes a column after [`apply`], with the range and the variance of the training rows.
pub(crate) fn describe(
    sources: &[Source],
    part: Part,
    fit: &Fit,
    uses_all_rows: bool,
) -> (EncodedFeature, Vec<f64>) {
    let dims = &encoded(&sources[0], part).dims;
    let mut infos = Vec::with_capacity(dims.len());
    let mut variances = Vec::with_capacity(dims.len());
    for (i, (dim, affine)) in dims.iter().zip(&fit.dims).enumerate() {
        let (n, _, squares) = moments(sources, part, i, |e| uses_all_rows || e.is_training);
        variances.push(if n > 0 { squares / n as f64 } else { 0.0 });
        let (min, max) = range(sources, part, i, uses_all_rows);
        infos.push(StandardisedDimInfo {
            name: dim.name.clone(),
            feature: dim.feature.clone(),
            unit: dim.unit.clone(),
            mean: affine.mean,
            scale: affine.scale,
            is_constant: affine.is_constant,
            min,
            max,
        });
    }
    let (fitted_on, fitted_hash) = (fit.fitted_on.clone(), fit.fitted_hash);
    (EncodedFeature { dims: infos, fitted_on, fitted_hash }, variances)
}

/// Returns smallest and largest valid value of the training rows; zeros where there is none.
fn range(sources: &[Source], part: Part, dim: usize, uses_all_rows: bool) -> (f64, f64) {
    let (mut min, mut max) = (f64::INFINITY, f64::NEG_INFINITY);
    for source in sources {
        let values = values(source, part);
        for episode in source.episodes.iter().filter(|e| uses_all_rows || e.is_training) {
            let first = episode.first_row as usize;
            for row in (first..first + episode.rows).filter(|row| values.is_valid(*row, dim)) {
                (min, max) = (min.min(values.get(row, dim)), max.max(values.get(row, dim)));
            }
        }
    }
    if min <= max { (min, max) } else { (0.0, 0.0) }
}
