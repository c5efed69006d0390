//! Results of a benchmark of speed against error: rows, means over scenes, and their table, CSV file and plot.
//!
//! Times depend on the machine. Time ratios within one run, errors and FFT counts hardly do.

use std::fmt::Write as _;

use serde::Serialize;

use super::Scores;
use crate::output::plot::{Series, plot};
use stokescope_core::image::Picture;
use stokescope_core::image::Size;

/// Method that times are compared with: the strongest reading of the published one on scenes that go on beyond the frame.
pub const REFERENCE: &str = "fista-published-scaled";
/// Scene name of rows that are means over scenes.
pub const MEAN: &str = "mean";

/// Result of a method with one number of iterations on one scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Scene, or [`MEAN`].
    pub scene: String,
    /// Width of the frames in pixels.
    pub width: usize,
    /// Height of the frames in pixels.
    pub height: usize,
    /// Method, or `guide-only`: S0 from the guide, unpolarized.
    pub method: String,
    /// Iterations.
    pub iterations: usize,
    /// Figures; `None` when the method diverged (for a mean: on any scene).
    #[serde(flatten)]
    pub figures: Option<Figures>,
}

/// Errors, time and memory of one result.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figures {
    /// Errors against the truth.
    #[serde(flatten)]
    pub scores: Scores,
    /// Time of the solver for one frame, in seconds.
    pub seconds: f64,
    /// Time divided by that of [`REFERENCE`] with its most iterations; `None` if that did not run.
    pub time_ratio: Option<f64>,
    /// Number of complex 2-D FFTs of the padded size.
    pub ffts: f64,
    /// Memory of solver and preparation in bytes.
    pub workspace_bytes: usize,
}

impl Row {
    fn size(&self) -> Size {
        Size::new(self.width, self.height)
    }
}

/// Means over scenes for each size, method and number of iterations, in order of first appearance.
pub fn means(rows: &[Row]) -> Vec<Row> {
    let mut means: Vec<Row> = Vec::new();
    for row in rows {
        let same = |r: &Row| (r.size(), &r.method, r.iterations) == (row.size(), &row.method, row.iterations);
        if means.iter().any(same) {
            continue;
        }
        let all: Option<Vec<Figures>> = rows.iter().filter(|r| same(r)).map(|r| r.figures).collect();
        let figures = all.map(|all| {
            let mean = |f: fn(&Figures) -> f64| all.iter().map(f).sum::<f64>() / all.len() as f64;
            Figures {
                scores: Scores {
                    psnr: mean(|f| f.scores.psnr),
                    ssim: mean(|f| f.scores.ssim),
                    s12_psnr: mean(|f| f.scores.s12_psnr),
                    dolp_mae: mean(|f| f.scores.dolp_mae),
                    aolp_mae_deg: mean(|f| f.scores.aolp_mae_deg),
                },
                seconds: mean(|f| f.seconds),
                time_ratio: None,
                ffts: mean(|f| f.ffts),
                workspace_bytes: all.iter().map(|f| f.workspace_bytes).max().unwrap_or(0),
            }
        });
        means.push(Row { scene: MEAN.to_owned(), figures, ..row.clone() });
    }
    set_time_ratios(&mut means);
    means
}

/// Sets the time ratios within each scene and size.
pub fn set_time_ratios(rows: &mut [Row]) {
    let references: Vec<_> = rows.iter().filter(|r| r.method == REFERENCE).cloned().collect();
    for row in rows {
        let of_row = |r: &&Row| r.scene == row.scene && r.size() == row.size() && r.figures.is_some();
        let longest = references.iter().filter(of_row).max_by_key(|r| r.iterations).and_then(|r| r.figures);
        if let (Some(figures), Some(longest)) = (&mut row.figures, longest) {
            figures.time_ratio = Some(figures.seconds / longest.seconds);
        }
    }
}

/// Formats rows as an aligned text table.
pub fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<9}  {:<22}  {:>10}  {:>9}  {:>6}  {:>10}  {:>6}  {:>10}  {:>10}  {:>9}  {:>6}  {:>6}\n",
        "size",
        "method",
        "iterations",
        "PSNR [dB]",
        "SSIM",
        "S1,S2 [dB]",
        "DoLP",
        "AoLP [deg]",
        "time [ms]",
        "time ratio",
        "FFTs",
        "MB"
    );
    for row in rows {
        let _ = write!(text, "{:<9}  {:<22}  {:>10}  ", row.size().to_string(), row.method, row.iterations);
        let Some(Figures { scores: s, seconds, time_ratio, ffts, workspace_bytes }) = row.figures else {
            text.push_str(" diverged\n");
            continue;
        };
        let ratio = time_ratio.map_or("-".to_owned(), |r| format!("{r:.4}"));
        let _ = writeln!(
            text,
            "{:>9.2}  {:>6.4}  {:>10.2}  {:>6.4}  {:>10.2}  {:>10.2}  {ratio:>10}  {ffts:>6.0}  {:>6.1}",
            s.psnr,
            s.ssim,
            s.s12_psnr,
            s.dolp_mae,
            s.aolp_mae_deg,
            1e3 * seconds,
            workspace_bytes as f64 / 1e6
        );
    }
    text
}

/// For each method, one line about the fastest row whose S1, S2 error is no larger than that of the reference.
pub fn at_equal_error(means: &[Row]) -> Vec<String> {
    let longest = |size: Size| {
        let is_reference = |r: &&Row| r.method == REFERENCE && r.size() == size;
        means.iter().filter(is_reference).filter_map(|r| r.figures.map(|f| (r, f))).max_by_key(|(r, _)| r.iterations)
    };
    let mut lines = Vec::new();
    let mut seen = Vec::new();
    for row in means {
        if row.method == REFERENCE || seen.contains(&(row.size(), &row.method)) {
            continue;
        }
        seen.push((row.size(), &row.method));
        let Some((reference, goal)) = longest(row.size()) else { continue };
        let reached = means
            .iter()
            .filter(|r| r.size() == row.size() && r.method == row.method)
            .filter_map(|r| r.figures.map(|f| (r, f)))
            .filter(|(_, f)| f.scores.s12_psnr >= goal.scores.s12_psnr)
            .min_by(|a, b| a.1.seconds.total_cmp(&b.1.seconds));
        let target = format!("{REFERENCE} with {} iterations ({:.2} dB)", reference.iterations, goal.scores.s12_psnr);
        lines.push(match reached {
            Some((_, f)) if f.seconds <= 0.0 => {
                format!("{}: {:.2} dB without solving; {target}", row.method, f.scores.s12_psnr)
            }
            Some((r, f)) => format!(
                "{}: {:.2} dB with {} iterations in 1/{:.1} of the time of {target}",
                r.method,
                f.scores.s12_psnr,
                r.iterations,
                goal.seconds / f.seconds
            ),
            None => format!("{}: did not reach {target}", row.method),
        });
    }
    lines
}

/// Formats rows as comma-separated values, one line per row after a header.
pub fn csv(rows: &[Row]) -> String {
    let mut text =
        "scene,width,height,method,iterations,psnr,ssim,s12_psnr,dolp_mae,aolp_mae_deg,seconds,time_ratio,ffts,\
                    workspace_bytes\n"
            .to_owned();
    for row in rows {
        let _ = write!(text, "{},{},{},{},{},", quoted(&row.scene), row.width, row.height, row.method, row.iterations);
        let Some(Figures { scores: s, seconds, time_ratio, ffts, workspace_bytes }) = row.figures else {
            text.push_str(",,,,,,,,\n");
            continue;
        };
        let ratio = time_ratio.map_or(String::new(), |r| r.to_string());
        let _ = writeln!(
            text,
            "{},{},{},{},{},{seconds},{ratio},{ffts},{workspace_bytes}",
            s.psnr, s.ssim, s.s12_psnr, s.dolp_mae, s.aolp_mae_deg
        );
    }
    text
}

/// Quotes a field as in RFC 4180 where needed.
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}

/// Plots the S1, S2 PSNR against time, one curve per method; only the first size is shown.
pub fn picture(means: &[Row]) -> Picture {
    let mut series: Vec<Series> = Vec::new();
    for row in means.iter().filter(|r| r.size() == means[0].size()) {
        let Some(f) = row.figures else { continue };
        let point = (f.seconds, f.scores.s12_psnr);
        match series.iter_mut().find(|s| s.name == row.method) {
            Some(s) => s.points.push(point),
            None => series.push(Series { name: row.method.clone(), points: vec![point] }),
        }
    }
    plot(&series, "speed against error, mean of the scenes", "seconds per frame", "S1,S2 PSNR (dB)")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(scene: &str, method: &str, iterations: usize, s12_psnr: f64, seconds: f64) -> Row {
        let scores = Scores { psnr: s12_psnr + 5.0, ssim: 0.9, s12_psnr, dolp_mae: 0.05, aolp_mae_deg: 3.25 };
        let figures = Figures { scores, seconds, time_ratio: None, ffts: 4.0, workspace_bytes: 2_500_000 };
        let (scene, method) = (scene.to_owned(), method.to_owned());
        Row { scene, width: 64, height: 48, method, iterations, figures: Some(figures) }
    }

    fn rows() -> Vec<Row> {
        let mut rows = vec![
            row("a", "guided", 1, 30.0, 0.01),
            row("a", REFERENCE, 20, 10.0, 0.1),
            row("a", REFERENCE, 500, 20.0, 2.0),
            row("b,c", "guided", 1, 34.0, 0.03),
            row("b,c", REFERENCE, 20, 12.0, 0.1),
            row("b,c", REFERENCE, 500, 24.0, 2.0),
            row("a", "fista", 60, 50.0, 0.1),
            row("b,c", "fista", 60, 50.0, 0.1),
        ];
        rows[7].figures = None;
        set_time_ratios(&mut rows);
        rows
    }

    #[test]
    fn times_are_compared_with_the_longest_reference_of_the_scene() {
        let ratios: Vec<_> = rows().iter().map(|r| r.figures.and_then(|f| f.time_ratio)).collect();
        assert_eq!(ratios[..4], [Some(0.005), Some(0.05), Some(1.0), Some(0.015)]);
        assert_eq!(ratios[7], None);
    }

    #[test]
    fn means_are_over_scenes_and_a_method_that_fails_anywhere_has_none() {
        let means = means(&rows());
        assert_eq!(means.len(), 4);
        let guided = means[0].figures.unwrap();
        assert_eq!((guided.scores.s12_psnr, guided.seconds, guided.time_ratio), (32.0, 0.02, Some(0.01)));
        assert_eq!((means[3].method.as_str(), means[3].figures), ("fista", None));
    }

    #[test]
    fn the_table_is_aligned() {
        let text = table(&means(&rows()));
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 5);
        assert_eq!(
            lines[1],
            "64×48      guided                           1      37.00  0.9000       32.00  0.0500        3.25       20.00      0.0100       4     2.5"
        );
        let widths: Vec<_> = lines[..4].iter().map(|l| l.chars().count()).collect();
        assert!(widths.iter().all(|w| *w == widths[0]), "{widths:?}");
        assert!(lines[4].ends_with("diverged"));
    }

    #[test]
    fn equal_error_names_the_fastest_row_that_is_good_enough() {
        let lines = at_equal_error(&means(&rows()));
        let expected = "guided: 32.00 dB with 1 iterations in 1/100.0 of the time of fista-published-scaled with 500 iterations (22.00 dB)";
        assert_eq!(lines[0], expected);
        assert!(lines[1].starts_with("fista: did not reach"));
    }

    #[test]
    fn csv_has_one_field_for_each_heading() {
        let text = csv(&rows());
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[1], "a,64,48,guided,1,35,0.9,30,0.05,3.25,0.01,0.005,4,2500000");
        assert!(lines[4].starts_with("\"b,c\",64,48,"));
        let fields = |line: &str| line.matches(',').count();
        assert_eq!((fields(lines[1]), fields(lines[8])), (fields(lines[0]), fields(lines[0]) + 1));
    }

    #[test]
    fn json_holds_the_figures_flat() {
        let text = serde_json::to_value(&rows()[0]).unwrap();
        assert_eq!((text["s12_psnr"].as_f64(), text["seconds"].as_f64()), (Some(30.0), Some(0.01)));
    }

    #[test]
    fn the_plot_shows_every_method_that_ran() {
        assert_ne!(picture(&means(&rows())), picture(&means(&rows()[..3])));
    }
}
