//! `stokescope export`: the results of a recorded session in one file for other programs.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::Error;
use crate::output::OutputError;
use crate::output::zarr::{Zarr, ZarrSpec};
use crate::session::{OmeTiff, Recording, SessionError};

/// Export the results of a recorded session.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Session, or a folder of sessions of which the newest is taken.
    #[arg(value_name = "DIR")]
    pub session: PathBuf,
    /// Format: ome-zarr is a folder with one chunk a frame, ome-tiff a file with one page a plane (BigTIFF).
    #[arg(long, value_enum)]
    pub format: ExportFormat,
    /// Name of the file or folder to be made, as leaf.ome.zarr or leaf.ome.tif.
    #[arg(long, value_name = "PATH")]
    pub out: PathBuf,
}

/// Value of `--format`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ExportFormat {
    /// OME-Zarr 0.5.
    OmeZarr,
    /// OME-TIFF.
    OmeTiff,
}

/// Exports the Stokes images, DoLP and AoLP of every complete frame. The file appears whole or not at all.
///
/// # Errors
/// A session that cannot be read, a name that is taken, or a disk that refuses; frames that were left out are told of in the end.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let recording = Recording::open(&args.session)?;
    if recording.is_empty() {
        let problem = "no frame whose files are all there".to_owned();
        return Err(SessionError::Replay { path: recording.session, problem }.into());
    }
    if args.out.symlink_metadata().is_ok() {
        return Err(OutputError::Occupied { path: args.out.clone(), what: "something already" }.into());
    }
    let (frames, out) = (recording.len() as u64, args.out.display().to_string());
    let (planes, lost, path) = (recording.planes.clone(), recording.damaged, recording.session.clone());
    match args.format {
        ExportFormat::OmeZarr => write_zarr(&recording, &args.out)?,
        ExportFormat::OmeTiff => write_tiff(recording, &args.out)?,
    }
    if json {
        println!("{}", serde_json::json!({ "out": out, "frames": frames, "planes": planes }));
    } else {
        println!("{out}: {frames} frames of {}", planes.join(", "));
    }
    if lost > 0 {
        return Err(SessionError::Incomplete { path, lost, frames: frames + lost }.into());
    }
    Ok(())
}

fn folder_of(out: &Path) -> &Path {
    out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn write_zarr(recording: &Recording, out: &Path) -> Result<(), Error> {
    let failed = |source| OutputError::Folder { path: out.to_path_buf(), source };
    let hidden = tempfile::Builder::new().prefix(".stokescope-").tempdir_in(folder_of(out)).map_err(failed)?;
    let made = hidden.path().join("export");
    let frames: Vec<String> = (0..recording.len()).map(|index| recording.name(index)).collect();
    let origin = recording.session.file_name().unwrap_or_default().to_string_lossy();
    let spec = ZarrSpec {
        planes: &recording.planes,
        size: recording.size,
        frames: &frames,
        interval: recording.interval(),
        origin: serde_json::json!({ "session": origin }),
    };
    let array = Zarr::create(&made, &spec)?;
    for index in 0..recording.len() {
        array.write(index, &recording.read(index)?)?;
    }
    Ok(std::fs::rename(&made, out).map_err(failed)?)
}

fn write_tiff(recording: Recording, out: &Path) -> Result<(), Error> {
    let failed = |source| OutputError::Folder { path: out.to_path_buf(), source };
    let mut file = tempfile::Builder::new().prefix(".stokescope-").tempfile_in(folder_of(out)).map_err(failed)?;
    let mut made = OmeTiff::new(recording)?;
    while let Some(part) = made.part()? {
        file.write_all(&part).map_err(failed)?;
    }
    file.as_file().sync_all().map_err(failed)?;
    file.persist_noclobber(out).map_err(|e| failed(e.error))?;
    Ok(())
}
