//! `stokescope trial`: opens one network and ends; started by the program itself for networks that are not shipped.

use std::path::PathBuf;

use stokescope_core::refine::Network;

use crate::Error;
use crate::model::{Model, OpenError, Precision, trial};

/// Open a network that is not shipped, within bounds of memory.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Manifest of the model.
    pub manifest: PathBuf,
    /// Precision of the network.
    #[arg(value_parser = super::values::precision())]
    pub precision: Precision,
}

/// Opens the network.
///
/// # Errors
/// Those of opening it.
pub fn run(args: &Args) -> Result<(), Error> {
    trial::bound();
    let name = args.manifest.to_str().ok_or_else(|| Error::Usage("the manifest's path is not UTF-8".to_owned()))?;
    let open = || -> Result<Network, OpenError> {
        let model = Model::load(name)?;
        let onnx = model.onnx(args.precision)?;
        Ok(Network::load(model.network, onnx)?)
    };
    Ok(open().map(drop)?)
}
