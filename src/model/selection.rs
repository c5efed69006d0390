//! Selection of the fusion model that runs: the one that is asked for, or the best shipped one that a frame's time and the memory
//! limit allow.

use super::{Choice, Model, OpenError, Precision};
use stokescope_core::pipeline::{Pipeline, PlanError};
use stokescope_core::refine::Network;

/// Time and memory that a model may take.
pub struct Allowance<'a> {
    /// Says why a model with arithmetic of a precision would be too slow for `auto`; none where it is fast enough.
    pub too_slow: &'a dyn Fn(&Model, Precision) -> Option<String>,
    /// Memory limit of a pipeline with a model, in bytes.
    pub limit: usize,
}

impl Allowance<'_> {
    /// All the time and memory that a model takes.
    pub const ALL: Self = Self { too_slow: &|_, _| None, limit: usize::MAX };
}

/// Why the chosen model cannot run.
#[derive(Debug, thiserror::Error)]
pub enum SelectionError {
    /// The model does not exist or cannot be run.
    #[error(transparent)]
    Model(#[from] OpenError),
    /// It does not fit.
    #[error(transparent)]
    Plan(#[from] PlanError),
}

/// The fusion model that runs, and why.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Selection {
    /// Name of the model; none for physics only.
    pub model: Option<String>,
    /// Number format of its arithmetic.
    pub precision: Option<Precision>,
    /// The reason, for humans.
    pub why: String,
}

impl Selection {
    /// Adds the chosen model to a pipeline without one. `auto` takes the first shipped model that is fast enough and fits within the
    /// memory limit, and none for pipelines without a guide or a mask. Allocates.
    ///
    /// # Errors
    /// A model that is asked for by name and does not exist, cannot be run or does not fit.
    pub fn add(
        pipeline: &mut Pipeline,
        choice: &Choice,
        precision: Precision,
        allowance: &Allowance<'_>,
    ) -> Result<Self, SelectionError> {
        let physics = |why: String| Ok(Self { model: None, precision: None, why });
        if pipeline.angles().is_empty() {
            return physics("without a mask there is no polarization to refine".to_owned());
        }
        match choice {
            Choice::Off => physics("switched off".to_owned()),
            Choice::Named(name) => {
                let network = Model::load(name).map_err(OpenError::from)?.open(precision)?;
                pipeline.add_fusion(&network, allowance.limit)?;
                Ok(Self::of(&network, "asked for".to_owned()))
            }
            Choice::Auto if !pipeline.settings().guided => {
                physics("auto: the models are trained with a guide".to_owned())
            }
            Choice::Auto => Self::automatic(pipeline, precision, allowance),
        }
    }

    fn automatic(
        pipeline: &mut Pipeline,
        precision: Precision,
        allowance: &Allowance<'_>,
    ) -> Result<Self, SelectionError> {
        let mut passed: Vec<String> = Vec::new();
        for name in Model::shipped() {
            let model = Model::load(name).map_err(OpenError::from)?;
            let precision = if model.precisions().contains(&precision) { precision } else { Precision::F32 };
            // to open a model takes time and memory that a board which is too slow for it has better uses for
            if let Some(slow) = (allowance.too_slow)(&model, precision) {
                passed.push(format!("{name} ({slow})"));
                continue;
            }
            let refusal = match model.open(precision) {
                Err(OpenError::Network(e)) => e.to_string(),
                Err(e) => return Err(e.into()),
                Ok(network) => match pipeline.add_fusion(&network, allowance.limit) {
                    Ok(()) => {
                        let more = passed.iter().map(|why| format!("; not {why}")).collect::<String>();
                        let why = format!("auto: the best model that time and memory allow{more}");
                        return Ok(Self::of(&network, why));
                    }
                    Err(PlanError::Memory { total, limit, .. }) => {
                        let [total, limit] = [total, limit].map(|bytes| bytes as f64 / f64::from(1 << 20));
                        format!("{total:.1} MiB with room for light from beyond the frame, allowed: {limit:.1}")
                    }
                    Err(e) => return Err(e.into()),
                },
            };
            passed.push(format!("{name} ({refusal})"));
        }
        Ok(Self { model: None, precision: None, why: format!("auto: no model fits: {}", passed.join(", ")) })
    }

    fn of(network: &Network, why: String) -> Self {
        Self { model: Some(network.model().name.clone()), precision: Some(network.precision()), why }
    }
}
