//! Pictures for watchers: views of the latest frame, drawn and encoded once for all who watch them.

mod broadcast;
mod painter;
mod view;

pub(super) use broadcast::{BOUNDARY, Broadcast, PictureFormat, Still, Watch};
pub(super) use painter::Painter;
pub(super) use view::View;
