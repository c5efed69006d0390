//! `stokescope cameras`: lists the cameras that can be opened.

use crate::Error;
use crate::camera::{AvailableCamera, BACKENDS};

/// Prints the cameras of every backend with their modes, or why a backend is not available; with `json` one object.
///
/// # Errors
/// The first error of a backend, after everything else was printed.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(json: bool) -> Result<(), Error> {
    let mut failed = None;
    let mut backends = Vec::new();
    for backend in BACKENDS {
        let available = (backend.available)();
        let offers = match &available {
            Ok(()) => (backend.list)().unwrap_or_else(|e| {
                failed.get_or_insert(e);
                Vec::new()
            }),
            Err(_) => Vec::new(),
        };
        backends.push((backend, available, offers));
    }
    if json {
        let list: Vec<_> = backends
            .iter()
            .map(|(backend, available, offers)| {
                serde_json::json!({
                    "name": backend.name, "description": backend.description, "available": available.is_ok(),
                    "reason": available.as_ref().err(), "cameras": offers.iter().map(camera).collect::<Vec<_>>(),
                })
            })
            .collect();
        println!("{}", serde_json::json!({ "backends": list }));
    } else {
        for (backend, available, offers) in &backends {
            println!("{}: {}", backend.name, backend.description);
            match available {
                Err(reason) => println!("  not available: {reason}"),
                Ok(()) if backend.live && offers.is_empty() => println!("  none found"),
                Ok(()) => offers.iter().for_each(show),
            }
        }
    }
    failed.map_or(Ok(()), |e| Err(e.into()))
}

#[allow(clippy::print_stdout, reason = "output of the command")]
fn show(offer: &AvailableCamera) {
    println!("  {}  {}", offer.source, offer.description);
    for mode in &offer.modes {
        let mut names = if mode.formats.is_empty() { "not supported".to_owned() } else { mode.formats.join(", ") };
        if let Some(bits) = mode.bits {
            names += &format!(", bits = {bits}");
        }
        println!("    {:<20} {:<18} {}", names, mode.driver_name, mode.sizes.join(", "));
    }
}

fn camera(offer: &AvailableCamera) -> serde_json::Value {
    let modes = offer.modes.iter().map(
        |mode| serde_json::json!({ "formats": mode.formats, "bits": mode.bits, "driver_format": mode.driver_name, "sizes": mode.sizes }),
    );
    serde_json::json!({
        "source": offer.source, "description": offer.description, "modes": modes.collect::<Vec<_>>(),
    })
}
