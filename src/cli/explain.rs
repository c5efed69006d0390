//! `stokescope explain`: a result folder as one page of plain sentences and pictures.

use std::path::{Path, PathBuf};

use stokescope_core::image::{Picture, Size};
use stokescope_core::polarization::color;
use stokescope_core::uncertainty::dolp_error;

use crate::Error;
use crate::files::{self, ArrayError, read_npy, write_atomic};
use crate::output::explain::{ERROR_PICTURE, Facts, page};
use crate::output::panel::write_png;

/// Name of the page.
const PAGE: &str = "explain.html";
/// Most bytes of a report.
const MAX_REPORT: u64 = 4 << 20;

/// Explain a result in plain sentences and pictures.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of a result: of `reconstruct --out`, of `run`, or of one of its frames.
    #[arg(value_name = "RESULT")]
    pub result: PathBuf,
}

/// Writes `explain.html` and a picture of the standard errors into the folder of the result, and prints where.
///
/// # Errors
/// A report or an array that cannot be read, with its file; a page that cannot be written.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let folder = &args.result;
    let facts = read_report(&folder.join("report.json"))?;
    let picture = error_picture(folder)?;
    if let Some(picture) = &picture {
        write_png(&folder.join(ERROR_PICTURE), picture)?;
    }
    let shows = |name: &str| if name == ERROR_PICTURE { picture.is_some() } else { folder.join(name).is_file() };
    let html = page(&facts, shows);
    let path = folder.join(PAGE);
    write_atomic(&path, |out| out.write_all(html.as_bytes()))?;
    let shown = path.display().to_string();
    println!("{}", if json { serde_json::json!({ "page": shown }).to_string() } else { shown });
    Ok(())
}

fn read_report(path: &Path) -> Result<Facts, Error> {
    let text = files::read_bytes(path, MAX_REPORT).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => Error::Array(ArrayError::Missing(path.to_path_buf())),
        _ => Error::Array(ArrayError::Io { path: path.to_path_buf(), source }),
    })?;
    serde_json::from_slice(&text).map_err(|error| {
        let allowed = "the report.json of a result folder, as reconstruct and run write it";
        Error::Array(ArrayError::Unsupported {
            path: path.to_path_buf(),
            what: "report",
            found: error.to_string(),
            allowed,
        })
    })
}

/// Standard error of the DoLP of the Stokes images summed over the channels; none for a result without polarization or errors.
fn error_picture(folder: &Path) -> Result<Option<Picture>, Error> {
    let [stokes, errors] = ["stokes.npy", "stokes_error.npy"].map(|name| folder.join(name));
    if !errors.is_file() {
        return Ok(None);
    }
    let (stokes, read) = (read_npy(&stokes)?, read_npy(&errors)?);
    let shape = stokes.shape.clone();
    let [.., planes, height, width] = shape[..] else { return Ok(None) };
    if read.shape != shape || planes != 3 || shape.len() > 4 {
        let found = format!("{:?} beside stokes of {shape:?}", read.shape);
        return if planes == 3 {
            Err(ArrayError::Unsupported { path: errors, what: "shape", found, allowed: "the shape of stokes.npy" }
                .into())
        } else {
            Ok(None)
        };
    }
    let (stokes, read, n) = (stokes.into_f32(), read.into_f32(), width * height);
    let channels = || (0..stokes.len()).step_by(3 * n);
    let pixel = |i: usize| {
        let sum = |k: usize| channels().map(|c| stokes[c + k * n + i]).sum::<f32>();
        let error = |k: usize| channels().map(|c| read[c + k * n + i].powi(2)).sum::<f32>().sqrt();
        color::dolp_color(dolp_error([0, 1, 2].map(sum), [0, 1, 2].map(error)))
    };
    Ok(Some(Picture { size: Size::new(width, height), pixels: (0..n).map(pixel).collect() }))
}
