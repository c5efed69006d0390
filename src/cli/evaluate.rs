//! `stokescope evaluate`: scores estimates against the truth.

use std::path::PathBuf;

use serde::Serialize;

use crate::evaluate::{Scores, pairs, score_files};

/// Score angle images against the truth: PSNR, SSIM, errors of DoLP and AoLP.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// NPY file of angle images [P, H, W] or [C, P, H, W] at 0°, 45°, 90° (and 135°), or a folder of them.
    pub estimate: PathBuf,
    /// NPY file of the true angle images, or a folder of files with the same names.
    pub truth: PathBuf,
}

/// Scores of one file.
#[derive(Serialize)]
struct Row {
    name: String,
    #[serde(flatten)]
    scores: Scores,
}

/// Output for folders; for two files only their scores are printed.
#[derive(Serialize)]
struct Output<'a> {
    files: &'a [Row],
    mean: Scores,
}

/// Scores every pair, then prints a table, or with `json` one object: the scores of two files, or `files` and their `mean`.
///
/// # Errors
/// Files that cannot be read or scored, with their names.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), crate::Error> {
    let found = pairs(&args.estimate, &args.truth)?;
    for path in &found.unpaired {
        tracing::warn!("{}: no file of this name to compare with", path.display());
    }
    let score = |pair| Ok(score_files(pair)?);
    let scores = found.pairs.iter().map(score).collect::<Result<Vec<_>, crate::Error>>()?;
    let rows: Vec<Row> =
        found.pairs.into_iter().zip(scores).map(|(pair, scores)| Row { name: pair.name, scores }).collect();
    let text = match (json, args.estimate.is_dir()) {
        (false, _) => table(&rows),
        (true, true) => as_json(&Output { files: &rows, mean: mean(&rows) })?,
        (true, false) => as_json(&rows[0].scores)?,
    };
    println!("{text}");
    Ok(())
}

fn as_json(output: &impl Serialize) -> Result<String, crate::Error> {
    serde_json::to_string(output).map_err(|e| crate::Error::Internal(e.to_string()))
}

fn mean(rows: &[Row]) -> Scores {
    let of = |f: fn(&Scores) -> f64| rows.iter().map(|row| f(&row.scores)).sum::<f64>() / rows.len() as f64;
    Scores {
        psnr: of(|s| s.psnr),
        ssim: of(|s| s.ssim),
        s12_psnr: of(|s| s.s12_psnr),
        dolp_mae: of(|s| s.dolp_mae),
        aolp_mae_deg: of(|s| s.aolp_mae_deg),
    }
}

/// Formats one line per file, and the mean of several files.
fn table(rows: &[Row]) -> String {
    let mean = (rows.len() > 1).then(|| Row { name: "mean".to_owned(), scores: mean(rows) });
    let width = rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(4);
    let mut lines = vec![format!("{:width$}  PSNR [dB]    SSIM  S1,S2 [dB]    DoLP  AoLP [deg]", "file")];
    for Row { name, scores: s } in rows.iter().chain(&mean) {
        lines.push(format!(
            "{name:width$}  {:9.2}  {:6.4}  {:10.2}  {:6.4}  {:10.2}",
            s.psnr, s.ssim, s.s12_psnr, s.dolp_mae, s.aolp_mae_deg
        ));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, psnr: f64) -> Row {
        let scores = Scores { psnr, ssim: 0.9, s12_psnr: 31.25, dolp_mae: 0.0123, aolp_mae_deg: 2.5 };
        Row { name: name.to_owned(), scores }
    }

    #[test]
    fn the_table_is_aligned_and_ends_with_the_mean() {
        let expected = "\
file       PSNR [dB]    SSIM  S1,S2 [dB]    DoLP  AoLP [deg]
a.npy          30.00  0.9000       31.25  0.0123        2.50
longé.npy      40.00  0.9000       31.25  0.0123        2.50
mean           35.00  0.9000       31.25  0.0123        2.50";
        assert_eq!(table(&[row("a.npy", 30.0), row("longé.npy", 40.0)]), expected);
        assert_eq!(table(&[row("a.npy", 30.0)]).lines().count(), 2);
    }

    #[test]
    fn json_names_each_file_and_the_mean() {
        let rows = [row("a.npy", 30.0), row("b.npy", 40.0)];
        let text = as_json(&Output { files: &rows, mean: mean(&rows) }).unwrap();
        assert!(text.starts_with(r#"{"files":[{"name":"a.npy","psnr":30.0,"ssim":0.9,"#), "{text}");
        assert!(text.contains(r#""mean":{"psnr":35.0,"#), "{text}");
    }
}
