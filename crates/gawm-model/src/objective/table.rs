//! The weights of the objectives: presets, overrides, controls.

use candle_core::{DType, Device, Tensor};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Clips, LossTerm, Losses};
use crate::Result;
use crate::config::{InverseInput, ModelConfig};
use crate::pass::Pass;
use crate::random::permutation;

/// A term of the loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Term {
    /// Next-latent prediction.
    Prediction,
    /// State alignment: the physical state from latents.
    StateAlignment,
    /// Inverse dynamics: the action from latents.
    InverseDynamics,
    /// Sketched isotropic Gaussian regularisation.
    Sigreg,
    /// VICReg variance over the batch.
    Std,
    /// VICReg variance over time.
    StdTime,
    /// VICReg covariance over the batch.
    Covariance,
    /// VICReg covariance over time.
    CovarianceTime,
    /// Consecutive latents close to each other (PLDM).
    TemporalAlignment,
    /// Consecutive displacements parallel.
    Straightening,
}

impl Term {
    /// All terms in the order of the table.
    pub const ALL: [Term; 10] = [
        Term::Prediction,
        Term::StateAlignment,
        Term::InverseDynamics,
        Term::Sigreg,
        Term::Std,
        Term::StdTime,
        Term::Covariance,
        Term::CovarianceTime,
        Term::TemporalAlignment,
        Term::Straightening,
    ];

    /// The name in configurations and logs.
    pub fn name(self) -> &'static str {
        match self {
            Term::Prediction => "prediction",
            Term::StateAlignment => "state-alignment",
            Term::InverseDynamics => "inverse-dynamics",
            Term::Sigreg => "sigreg",
            Term::Std => "std",
            Term::StdTime => "std-time",
            Term::Covariance => "covariance",
            Term::CovarianceTime => "covariance-time",
            Term::TemporalAlignment => "temporal-alignment",
            Term::Straightening => "straightening",
        }
    }
}

/// A control experiment: what is broken on purpose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Control {
    /// Nothing.
    #[default]
    None,
    /// State targets go to other clips of the batch (with their masks): same statistics, no relation to the frames.
    StatesShuffled,
    /// Action chunks go to other clips of the batch, as input of the predictor and as target.
    ActionsShuffled,
}

impl Control {
    /// Permutes what the control says, by a permutation of the clips drawn for this step.
    pub(crate) fn apply(self, clips: &Clips, pass: &Pass) -> Result<Clips> {
        let mut clips = clips.clone();
        let b = clips.frames.dim(0)?;
        let order =
            || Tensor::from_vec(permutation(&mut pass.stream("control"), b as u32), b, clips.frames.device());
        match self {
            Control::None => {}
            Control::StatesShuffled => {
                let order = order()?;
                clips.states = clips.states.contiguous()?.index_select(&order, 0)?;
                clips.state_mask = clips.state_mask.contiguous()?.index_select(&order, 0)?;
            }
            Control::ActionsShuffled => {
                clips.actions = clips.actions.contiguous()?.index_select(&order()?, 0)?
            }
        }
        Ok(clips)
    }
}

/// Names of the presets of [`Objectives::preset`].
pub const PRESETS: [&str; 10] = [
    "sa-idm",
    "idm",
    "sa",
    "pred-only",
    "lewm",
    "pldm",
    "delta-jepa",
    "sa-idm-sigreg",
    "sa-shuffled",
    "actions-shuffled",
];

/// The weighted table of objectives.
#[derive(Debug, Clone, PartialEq)]
pub struct Objectives {
    /// Weight of each term, in the order of [`Term::ALL`]; 0 leaves it out.
    pub weights: [f64; Term::ALL.len()],
    /// Terms without a weight that are computed and logged all the same.
    pub monitored: Vec<Term>,
    /// What is broken on purpose.
    pub control: Control,
    /// Number of directions that SIGReg projects on.
    pub sigreg_projections: usize,
    /// What the inverse dynamics head sees, if the preset fixes it.
    pub inverse_input: Option<InverseInput>,
}

/// Why a table is refused.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ObjectiveError {
    /// No preset has this name.
    #[error("unknown objective preset {name:?}: expected one of {PRESETS:?}")]
    UnknownPreset {
        /// The name given.
        name: String,
    },
    /// A key or value does not belong into the table.
    #[error("objective table: {message}")]
    Syntax {
        /// What the parser says, with the place.
        message: String,
    },
    /// A weight is negative or not finite, or all are zero.
    #[error("weight of {term}: expected a finite number >= 0 and at least one above, got {got}")]
    Weight {
        /// The term, or `all`.
        term: &'static str,
        /// The weight.
        got: f64,
    },
    /// SIGReg without directions.
    #[error("sigreg-projections: expected 1 to 65536, got {got}")]
    Projections {
        /// The number given.
        got: usize,
    },
}

/// The table as it is written; [`Objectives::from_table`] reads it.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct ObjectivesTable {
    /// What the weights start from, one of [`PRESETS`]; `sa-idm` by default.
    preset: Option<String>,
    /// Weights that differ from the preset's; 0 leaves a term out.
    #[schemars(with = "std::collections::BTreeMap<Term, f64>")]
    weights: toml::Table,
    /// Terms without a weight that are computed and logged all the same.
    monitored: Vec<Term>,
    /// What is broken on purpose.
    control: Option<Control>,
    /// Number of directions that SIGReg projects on; 1024 by default.
    sigreg_projections: Option<usize>,
    /// What the inverse dynamics head sees.
    inverse_input: Option<InverseInput>,
}

impl Default for Objectives {
    fn default() -> Objectives {
        Objectives::of(&[(Term::Prediction, 1.0), (Term::StateAlignment, 1.0), (Term::InverseDynamics, 1.0)])
    }
}

impl Objectives {
    /// Makes a table of the given weights; the others are zero.
    pub fn of(weights: &[(Term, f64)]) -> Objectives {
        let mut table = [0.0; Term::ALL.len()];
        for &(term, weight) in weights {
            table[term as usize] = weight;
        }
        Objectives {
            weights: table,
            monitored: Vec::new(),
            control: Control::None,
            sigreg_projections: 1024,
            inverse_input: None,
        }
    }

    /// Returns a preset (see [`PRESETS`]).
    ///
    /// # Errors
    ///
    /// - [`ObjectiveError::UnknownPreset`] if there is none of this name.
    pub fn preset(name: &str) -> Result<Objectives, ObjectiveError> {
        use Term::{
            Covariance, InverseDynamics, Prediction, Sigreg, StateAlignment, Std, StdTime, TemporalAlignment,
        };
        let pred = (Prediction, 1.0);
        let (sa, idm) = ((StateAlignment, 1.0), (InverseDynamics, 1.0));
        let table = match name {
            "sa-idm" => Objectives::of(&[pred, sa, idm]),
            "idm" => Objectives::of(&[pred, idm]),
            "sa" => Objectives::of(&[pred, sa]),
            "pred-only" => Objectives::of(&[pred]),
            "lewm" => Objectives::of(&[pred, (Sigreg, 0.09)]),
            "pldm" => Objectives {
                inverse_input: Some(InverseInput::PairReversed),
                ..Objectives::of(&[
                    pred,
                    (Std, 18.0),
                    (StdTime, 0.7),
                    (Covariance, 12.0),
                    (TemporalAlignment, 0.2),
                ])
            },
            "delta-jepa" => {
                Objectives { inverse_input: Some(InverseInput::Difference), ..Objectives::of(&[pred, idm]) }
            }
            "sa-idm-sigreg" => Objectives::of(&[pred, sa, idm, (Sigreg, 0.09)]),
            "sa-shuffled" => {
                Objectives { control: Control::StatesShuffled, ..Objectives::of(&[pred, sa, idm]) }
            }
            "actions-shuffled" => {
                Objectives { control: Control::ActionsShuffled, ..Objectives::of(&[pred, sa, idm]) }
            }
            _ => return Err(ObjectiveError::UnknownPreset { name: name.to_owned() }),
        };
        Ok(table)
    }

    /// Returns the name of the preset that this table is, whatever is monitored beside it.
    pub fn preset_name(&self) -> Option<&'static str> {
        let bare = Objectives { monitored: Vec::new(), ..self.clone() };
        PRESETS.into_iter().find(|name| Objectives::preset(name).is_ok_and(|preset| preset == bare))
    }

    /// Reads a table such as `preset = "lewm"`, `weights = { sigreg = 0.02 }`, `monitored = ["straightening"]`.
    ///
    /// # Errors
    ///
    /// - [`ObjectiveError`] with the key or value that does not belong there.
    pub fn from_table(table: toml::Table) -> Result<Objectives, ObjectiveError> {
        let syntax = |message: String| ObjectiveError::Syntax { message };
        let overrides: ObjectivesTable =
            table.try_into().map_err(|error: toml::de::Error| syntax(error.message().to_owned()))?;
        let mut objectives = match &overrides.preset {
            Some(name) => Objectives::preset(name)?,
            None => Objectives::default(),
        };
        for (key, value) in overrides.weights {
            let Some(term) = Term::ALL.into_iter().find(|term| term.name() == key) else {
                let names = Term::ALL.map(Term::name);
                return Err(syntax(format!("unknown term {key:?} in weights: expected one of {names:?}")));
            };
            let weight = value.as_float().or(value.as_integer().map(|weight| weight as f64));
            let message = || format!("weight of {key}: expected a number, got {}", value.type_str());
            objectives.weights[term as usize] = weight.ok_or_else(|| syntax(message()))?;
        }
        objectives.monitored = overrides.monitored;
        objectives.control = overrides.control.unwrap_or(objectives.control);
        objectives.sigreg_projections = overrides.sigreg_projections.unwrap_or(objectives.sigreg_projections);
        objectives.inverse_input = overrides.inverse_input.or(objectives.inverse_input);
        objectives.check()
    }

    fn check(self) -> Result<Objectives, ObjectiveError> {
        for (term, got) in self.rows() {
            if !got.is_finite() || got < 0.0 {
                return Err(ObjectiveError::Weight { term: term.name(), got });
            }
        }
        if self.weights.iter().all(|&weight| weight == 0.0) {
            return Err(ObjectiveError::Weight { term: "all", got: 0.0 });
        }
        if !(1..=65_536).contains(&self.sigreg_projections) {
            return Err(ObjectiveError::Projections { got: self.sigreg_projections });
        }
        Ok(self)
    }

    /// Terms and weights in the order of [`Term::ALL`].
    pub fn rows(&self) -> impl Iterator<Item = (Term, f64)> + '_ {
        Term::ALL.into_iter().zip(self.weights)
    }

    /// Weight of a term.
    pub fn weight(&self, term: Term) -> f64 {
        self.weights[term as usize]
    }

    /// Whether a term is computed: it has a weight or is monitored.
    pub fn computes(&self, term: Term) -> bool {
        self.weight(term) > 0.0 || self.monitored.contains(&term)
    }

    /// Switches on the heads that the table needs, and off those that it does not.
    pub fn configure(&self, model: &mut ModelConfig) {
        model.state_head = self.computes(Term::StateAlignment);
        model.inverse_head = self.computes(Term::InverseDynamics);
        model.inverse_input = self.inverse_input.unwrap_or(model.inverse_input);
    }

    /// Computes the terms of the table and their weighted sum.
    pub(crate) fn evaluate(
        &self,
        compute: impl Fn(Term) -> Result<Tensor>,
        device: &Device,
    ) -> Result<Losses> {
        let mut total = Tensor::zeros((), DType::F32, device)?;
        let mut terms = Vec::new();
        for (term, weight) in self.rows().filter(|&(term, _)| self.computes(term)) {
            let value = compute(term)?;
            if weight > 0.0 {
                total = (total + (&value * weight)?)?;
            }
            terms.push(LossTerm { term, weight, value: value.detach() });
        }
        Ok(Losses { total, terms })
    }
}
