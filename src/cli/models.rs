//! `stokescope models`: which fusion models are shipped.

use crate::Error;
use crate::model::NONE_SHIPPED;

/// Prints the list, which is empty.
///
/// # Errors
/// None.
#[allow(clippy::print_stdout, reason = "the command's answer")]
pub fn run(json: bool) -> Result<(), Error> {
    if json {
        println!("{}", serde_json::json!({ "models": [] }));
    } else {
        println!("{NONE_SHIPPED}");
    }
    Ok(())
}
