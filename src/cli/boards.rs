//! `stokescope boards`: lists the shipped boards.

use crate::Error;
use crate::board::Board;

/// Prints name and description of every shipped board, or one JSON object.
///
/// # Errors
/// None for the shipped files, which tests validate.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(json: bool) -> Result<(), Error> {
    let boards = Board::shipped().map(Board::load).collect::<Result<Vec<_>, _>>()?;
    if json {
        let list: Vec<_> = boards
            .iter()
            .map(|b| {
                serde_json::json!({
                    "name": b.name, "description": b.description, "soc": b.soc, "threads": b.threads,
                    "memory_limit_bytes": b.memory_limit_bytes, "iterations": b.iterations,
                })
            })
            .collect();
        println!("{}", serde_json::json!({ "boards": list }));
        return Ok(());
    }
    let width = boards.iter().map(|b| b.name.len()).max().unwrap_or(0);
    for b in &boards {
        println!("{:width$}  {:>5} MiB  {}", b.name, b.memory_limit_bytes >> 20, b.description);
    }
    Ok(())
}
