//! `stokescope models`: lists the shipped fusion models and those in `models/`.

use crate::Error;
use crate::model::{LOCAL, Model, ModelError};

/// Prints name, precisions, metrics and description of every model, or one JSON object. A model that is not usable is listed with
/// the reason.
///
/// # Errors
/// None.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(json: bool) -> Result<(), Error> {
    let names: Vec<String> = Model::shipped().map(str::to_owned).chain(Model::local()).collect();
    let models: Vec<_> = names.into_iter().map(|name| (Model::load(&name).and_then(verified), name)).collect();
    if json {
        let list: Vec<_> = models.iter().map(|(model, name)| describe(name, model)).collect();
        println!("{}", serde_json::json!({ "models": list }));
        return Ok(());
    }
    if Model::shipped().next().is_none() {
        println!("no models are shipped: reconstruction is physics only unless {LOCAL}/ contains a model");
    }
    let width = models.iter().map(|(_, name)| name.len()).max().unwrap_or(0);
    for (model, name) in &models {
        match model {
            Ok(m) => {
                let precisions: Vec<_> = m.precisions().iter().map(ToString::to_string).collect();
                let metrics: String = m.metrics.iter().map(|(key, value)| format!(", {key} {value}")).collect();
                println!("{name:width$}  {:8}  {}{metrics}", precisions.join(" "), m.description);
            }
            Err(e) => println!("{name:width$}  unusable  {e}"),
        }
    }
    Ok(())
}

/// Checks that all files of a model match its manifest.
fn verified(model: Model) -> Result<Model, ModelError> {
    model.precisions().into_iter().try_for_each(|precision| model.onnx(precision).map(drop))?;
    Ok(model)
}

fn describe(name: &str, model: &Result<Model, ModelError>) -> serde_json::Value {
    match model {
        Ok(m) => serde_json::json!({
            "name": name, "description": m.description, "licence": m.licence, "shipped": m.is_shipped(),
            "precisions": m.precisions(), "tile": m.network.tiling.tile, "trained": m.trained, "metrics": m.metrics,
        }),
        Err(e) => serde_json::json!({ "name": name, "error": e.to_string() }),
    }
}
