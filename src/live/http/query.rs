//! Queries of requests.

use std::collections::HashMap;

use serde::Deserialize;

use super::refusal::{Refusal, printable};
use crate::live::preview::{PictureFormat, View};
use stokescope_core::image::Size;

/// Keys and values of a query.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(transparent)]
pub(super) struct Parameters(HashMap<String, String>);

impl Parameters {
    pub(super) fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    /// Name of the view.
    pub(super) fn view(&self) -> &str {
        self.get("view").unwrap_or("aolp")
    }

    /// Format of a snapshot.
    pub(super) fn format(&self) -> Result<PictureFormat, Refusal> {
        match self.get("format") {
            None | Some("jpeg" | "jpg") => Ok(PictureFormat::Jpeg),
            Some("png") => Ok(PictureFormat::Png),
            Some(other) => {
                Err(Refusal::Query { key: "format", found: printable(other), allowed: "jpeg or png".to_owned() })
            }
        }
    }

    /// The views that are asked for of those there are; all of them where none is named.
    pub(super) fn views(&self, known: &[View]) -> Result<Vec<View>, Refusal> {
        let Some(text) = self.get("views") else { return Ok(known.to_vec()) };
        let find = |name: &str| known.iter().find(|view| view.name() == name).copied();
        let allowed = || known.iter().copied().map(View::name).collect();
        let unknown = |name| Refusal::View { found: printable(name), allowed: allowed() };
        text.split(',').map(|name| find(name).ok_or_else(|| unknown(name))).collect()
    }

    /// Checks that a key has one of the values there are; the first of them is the default.
    pub(super) fn one_of(&self, key: &'static str, allowed: &[&'static str]) -> Result<&'static str, Refusal> {
        let found = self.get(key).unwrap_or(allowed[0]);
        allowed.iter().find(|value| **value == found).copied().ok_or_else(|| Refusal::Query {
            key,
            found: printable(found),
            allowed: allowed.join(" or "),
        })
    }

    /// A number of pixels.
    fn number(&self, key: &'static str) -> Result<usize, Refusal> {
        let found = self.get(key).unwrap_or_default();
        let refuse =
            |_| Refusal::Query { key, found: printable(found), allowed: "a number of pixels, from 0".to_owned() };
        found.parse().map_err(refuse)
    }

    /// Column and row of a pixel of an image of `size`.
    pub(super) fn pixel(&self, size: Size) -> Result<(usize, usize), Refusal> {
        let within = |key, below: usize| match self.number(key)? {
            found if found < below => Ok(found),
            found => Err(Refusal::Query {
                key,
                found: found.to_string(),
                allowed: format!("0 to {}", below.saturating_sub(1)),
            }),
        };
        Ok((within("x", size.width)?, within("y", size.height)?))
    }

    /// Left, top, width and height of a region; none when no part of it is given.
    pub(super) fn region(&self) -> Result<Option<[usize; 4]>, Refusal> {
        const KEYS: [&str; 4] = ["x", "y", "w", "h"];
        if KEYS.iter().all(|key| self.get(key).is_none()) {
            return Ok(None);
        }
        let [x, y, w, h] = KEYS.map(|key| self.number(key));
        Ok(Some([x?, y?, w?, h?]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn query(pairs: &[(&str, &str)]) -> Parameters {
        Parameters(pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect())
    }

    #[test]
    fn pixels_are_inside_the_image() {
        let pixel = |x, y| query(&[("x", x), ("y", y)]).pixel(Size::new(4, 3));
        assert_eq!(pixel("3", "2"), Ok((3, 2)));
        for (x, y) in [("4", "0"), ("0", "3"), ("-1", "0"), ("1e9", "0"), ("", "0")] {
            assert!(matches!(pixel(x, y), Err(Refusal::Query { .. })), "{x} {y}");
        }
        assert_eq!(pixel("4", "0").unwrap_err().to_string(), "x = 4, allowed: 0 to 3");
    }

    #[test]
    fn a_region_is_given_as_a_whole_or_not_at_all() {
        assert_eq!(query(&[("token", "t")]).region(), Ok(None));
        assert_eq!(query(&[("x", "1"), ("y", "2"), ("w", "3"), ("h", "4")]).region(), Ok(Some([1, 2, 3, 4])));
        assert!(query(&[("x", "1"), ("y", "2")]).region().is_err());
    }

    #[test]
    fn a_snapshot_is_jpeg_or_png() {
        assert_eq!(query(&[]).format(), Ok(PictureFormat::Jpeg));
        assert_eq!(query(&[("format", "png")]).format(), Ok(PictureFormat::Png));
        assert_eq!(query(&[("format", "gif")]).format().unwrap_err().to_string(), "format = gif, allowed: jpeg or png");
    }
}
