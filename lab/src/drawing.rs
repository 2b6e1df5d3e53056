//! Page, font and colours of all drawings.

use svg::Document;
use svg::node::element::Rectangle;

pub(crate) const INK: &str = "#222222";
/// Fonts of texts; the first available one is used.
pub(crate) const FONT: &str = "DejaVu Sans, Verdana, Helvetica, Arial, sans-serif";

/// An empty white page of a size in pixels, with texts of a height.
pub(crate) fn page(width: f64, height: f64, font_px: u32) -> Document {
    Document::new()
        .set("viewBox", (0, 0, round(width), round(height)))
        .set("width", round(width))
        .set("height", round(height))
        .set("font-family", FONT)
        .set("font-size", font_px)
        .set("fill", INK)
        .add(
            Rectangle::new()
                .set("width", "100%")
                .set("height", "100%")
                .set("fill", "white"),
        )
}

/// Tenths of a pixel are enough and keep the file small.
pub(crate) fn round(pixels: f64) -> f64 {
    (pixels * 10.0).round() / 10.0
}
