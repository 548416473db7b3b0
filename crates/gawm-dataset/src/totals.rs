//! Statistics of all columns over an episode, a recording or the dataset.

use gawm_schema::{DimStats, Moments};
use rayon::prelude::*;

use crate::block::{RowBlock, StoredValues};
use crate::columns::Columns;

/// Statistics of the stored columns. Merged episode by episode within a recording, then recording by recording, so
/// that appended, resumed and undisturbed runs give the same bits.
#[derive(Debug, Clone)]
pub(crate) struct Totals {
    /// Per vector feature, then per encoded column: per dim. Encoded dims that store the same bits as a raw dim are
    /// not counted; [`Totals::completed`] has them.
    pub(crate) dims: Vec<Vec<DimStats>>,
    /// Per encoded column and dim: moments of rows with valid features in training episodes.
    pub(crate) training: Vec<Vec<Moments>>,
    /// The same for all episodes.
    pub(crate) all: Vec<Vec<Moments>>,
    pub(crate) training_rows: u64,
    pub(crate) training_episodes: u64,
}

/// Below this many values a block is counted by one thread.
const PARALLEL_VALUES: usize = 1 << 14;

impl Totals {
    pub(crate) fn new(columns: &Columns) -> Totals {
        let vectors = columns.vectors.iter().map(|v| v.is_angle.iter().map(|&a| DimStats::new(a)).collect());
        let encoded = columns.encoded.iter().map(|e| vec![DimStats::new(false); e.encoder.width()]);
        let moments: Vec<_> =
            columns.encoded.iter().map(|e| vec![Moments::default(); e.encoder.width()]).collect();
        Totals {
            dims: vectors.chain(encoded).collect(),
            training: moments.clone(),
            all: moments,
            training_rows: 0,
            training_episodes: 0,
        }
    }

    /// Takes the rows of a block of one episode; [`Totals::end_episode`] says whether they are training data.
    pub(crate) fn update(&mut self, columns: &Columns, block: &RowBlock) {
        let stored: Vec<(&StoredValues, usize)> = block
            .vectors
            .iter()
            .zip(columns.vectors.iter().map(|v| v.width()))
            .chain(block.encoded.iter().zip(columns.encoded.iter().map(|e| e.encoder.width())))
            .collect();
        let n_vectors = columns.vectors.len();
        let n_values: usize = stored.iter().map(|(_, width)| width * block.len()).sum();
        let tasks: Vec<(&StoredValues, usize, usize, &mut DimStats)> = stored
            .iter()
            .zip(&mut self.dims)
            .enumerate()
            .flat_map(|(column, (&(values, width), stats))| {
                let is_counted = move |dim: usize| {
                    column.checked_sub(n_vectors).is_none_or(|e| columns.encoded[e].same_as[dim].is_none())
                };
                stats
                    .iter_mut()
                    .enumerate()
                    .filter(move |(dim, _)| is_counted(*dim))
                    .map(move |(dim, stats)| (values, width, dim, stats))
            })
            .collect();
        let count = |(values, width, dim, stats): (&StoredValues, usize, usize, &mut DimStats)| {
            let mut column = Vec::with_capacity(block.len());
            values.copy_dim(dim, width, &mut column);
            column.into_iter().for_each(|value| stats.update(value));
        };
        if n_values >= PARALLEL_VALUES {
            tasks.into_par_iter().for_each(count);
        } else {
            tasks.into_iter().for_each(count);
        }
        for (e, plan) in columns.encoded.iter().enumerate() {
            let width = plan.encoder.width();
            let is_valid: Vec<bool> = (0..block.len())
                .map(|row| plan.inputs.iter().all(|&(vector, _)| block.valid[vector][row]))
                .collect();
            let mut column = Vec::with_capacity(block.len());
            for (dim, moments) in self.all[e].iter_mut().enumerate() {
                column.clear();
                block.encoded[e].copy_dim(dim, width, &mut column);
                column
                    .iter()
                    .zip(&is_valid)
                    .filter(|(value, valid)| **valid && value.is_finite())
                    .for_each(|(value, _)| moments.update(*value));
            }
        }
    }

    /// Returns the statistics of all columns: per vector feature, then per encoded column.
    pub(crate) fn completed(&self, columns: &Columns) -> Vec<Vec<DimStats>> {
        let mut dims = self.dims.clone();
        let (vectors, encoded) = dims.split_at_mut(columns.vectors.len());
        for (plan, stats) in columns.encoded.iter().zip(encoded) {
            for (same, stats) in plan.same_as.iter().zip(stats) {
                if let Some((vector, dim)) = *same {
                    *stats = DimStats { circular: None, ..vectors[vector][dim].clone() };
                }
            }
        }
        dims
    }

    /// Marks everything counted so far as one episode.
    pub(crate) fn end_episode(&mut self, is_training: bool) {
        if is_training {
            self.training = self.all.clone();
            self.training_rows = self.all.iter().flatten().map(Moments::count).max().unwrap_or(0);
            self.training_episodes = 1;
        }
    }

    /// Takes the totals of later episodes.
    pub(crate) fn merge(&mut self, later: &Totals) {
        let n_items: usize = later.dims.iter().flatten().map(|stats| stats.sketch.len()).sum();
        let pairs: Vec<(&mut DimStats, &DimStats)> =
            self.dims.iter_mut().flatten().zip(later.dims.iter().flatten()).collect();
        if n_items >= PARALLEL_VALUES {
            pairs.into_par_iter().for_each(|(own, later)| own.merge(later));
        } else {
            pairs.into_iter().for_each(|(own, later)| own.merge(later));
        }
        for (own, later) in [(&mut self.training, &later.training), (&mut self.all, &later.all)] {
            own.iter_mut().flatten().zip(later.iter().flatten()).for_each(|(own, later)| own.merge(later));
        }
        self.training_rows += later.training_rows;
        self.training_episodes += later.training_episodes;
    }
}
