//! Anchor boxes of the network, as in TensorFlow's `create_ssd_anchors`.

use ecod::model::detection::BoundingBox;

/// Cells a side of each feature map.
const MAPS: [u16; 6] = [19, 10, 5, 3, 2, 1];
/// Anchor size per feature map as a share of the image, and one more for the last geometric mean.
const SCALES: [f64; 7] = [0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0];

/// A box in shares of the image's sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Anchor {
    center_x: f64,
    center_y: f64,
    width: f64,
    height: f64,
}

impl Anchor {
    /// The box for the network's four outputs ty, tx, th, tw.
    pub(super) fn decode(&self, offsets: &[f32]) -> BoundingBox {
        let [ty, tx, th, tw] = std::array::from_fn(|i| f64::from(offsets[i]));
        let center_x = self.center_x + tx / 10.0 * self.width;
        let center_y = self.center_y + ty / 10.0 * self.height;
        let half_width = self.width * (tw / 5.0).exp() / 2.0;
        let half_height = self.height * (th / 5.0).exp() / 2.0;
        BoundingBox {
            x_min: center_x - half_width,
            y_min: center_y - half_height,
            x_max: center_x + half_width,
            y_max: center_y + half_height,
        }
    }
}

/// All anchors in the order of the network's outputs.
pub(super) fn all() -> Vec<Anchor> {
    let mut anchors = Vec::with_capacity(1917);
    for (map, cells) in MAPS.into_iter().enumerate() {
        let shapes = shapes(map);
        let center = |index: u16| (f64::from(index) + 0.5) / f64::from(cells);
        for (row, column) in (0..cells).flat_map(|row| (0..cells).map(move |column| (row, column)))
        {
            anchors.extend(shapes.iter().map(|&(scale, ratio)| Anchor {
                center_x: center(column),
                center_y: center(row),
                width: scale * f64::sqrt(ratio),
                height: scale / f64::sqrt(ratio),
            }));
        }
    }
    anchors
}

/// Scale and width-to-height ratio of the anchors of a feature map.
fn shapes(map: usize) -> Vec<(f64, f64)> {
    let scale = SCALES[map];
    if map == 0 {
        return vec![(0.1, 1.0), (scale, 2.0), (scale, 0.5)];
    }
    let mean = (scale * SCALES[map + 1]).sqrt();
    vec![
        (scale, 1.0),
        (scale, 2.0),
        (scale, 0.5),
        (scale, 3.0),
        (scale, 1.0 / 3.0),
        (mean, 1.0),
    ]
}
