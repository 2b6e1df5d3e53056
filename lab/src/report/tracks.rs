//! Figures of objects that move, as rows for pages and terminals.

use crate::eval::Reliability;
use crate::eval::tracks::{AP_DISTANCES_M, ThresholdScores, TrackScores};

/// Headings of the figures at a threshold, in the order of [`at`].
const AT_THRESHOLD: [&str; 13] = [
    "at confidence",
    "",
    "F1 %",
    "MODA %",
    "MODP %",
    "MOTA %",
    "IDF1 %",
    "HOTA %",
    "DetA %",
    "AssA %",
    "LocA %",
    "switches",
    "fragments",
];

/// Tables, each under its header: average precision of all and of every class, figures at two
/// thresholds, and the reliability of each stated probability.
pub(crate) fn tables(scores: &TrackScores) -> Vec<Vec<Vec<String>>> {
    let distances = AP_DISTANCES_M.map(|distance| format!("AP@{distance} %"));
    let row =
        |name: &str, objects: String, said: String, ap: &[Option<f64>; AP_DISTANCES_M.len()]| {
            [name.to_owned(), objects, said]
                .into_iter()
                .chain(ap.map(percent))
                .collect::<Vec<_>>()
        };
    let mut precision = vec![
        ["", "objects", "reported"]
            .map(str::to_owned)
            .into_iter()
            .chain(distances)
            .collect(),
    ];
    precision.push(row(
        "all",
        scores.objects.to_string(),
        scores.said.to_string(),
        &scores.ap_pct,
    ));
    if scores.class_ap_pct.len() > 1 {
        let of_class = scores.class_ap_pct.iter();
        precision.extend(of_class.map(|(label, ap)| row(label, String::new(), String::new(), ap)));
    }
    let thresholds = vec![
        AT_THRESHOLD.map(str::to_owned).to_vec(),
        at("best F1", scores.best_f1_pct, &scores.at_best_f1),
        at("default", None, &scores.at_default),
    ];
    let calibration = &scores.calibration;
    let stated = [
        ("confidence", Some(&calibration.confidence)),
        ("existence", calibration.existence.as_ref()),
    ];
    let reliability = stated
        .into_iter()
        .filter_map(|(name, of)| Some(self::reliability(name, of?)));
    [precision, thresholds]
        .into_iter()
        .chain(reliability)
        .collect()
}

/// One row for each bin of a reliability diagram, the expected calibration error last.
pub(crate) fn reliability(name: &str, of: &Reliability) -> Vec<Vec<String>> {
    let mut rows = vec![
        [name, "stated %", "right %", "objects"]
            .map(str::to_owned)
            .to_vec(),
    ];
    rows.extend(of.bins.iter().map(|bin| {
        let shares = [bin.stated_pct, bin.right_pct].map(|share| percent(Some(share)));
        [
            vec![String::new()],
            shares.to_vec(),
            vec![bin.objects.to_string()],
        ]
        .concat()
    }));
    rows.push(vec!["calibration error %".into(), percent(of.ece_pct)]);
    rows
}

/// Warning about frames without a map.
pub(crate) fn without_map(scores: &TrackScores) -> Option<String> {
    let TrackScores {
        frames,
        frames_with_map,
        ..
    } = scores;
    let missing = frames - frames_with_map;
    (missing > 0)
        .then(|| format!("{missing} of {frames} frames have no map: their objects are missed"))
}

fn at(name: &str, best_f1_pct: Option<f64>, scores: &ThresholdScores) -> Vec<String> {
    let ThresholdScores {
        matches,
        false_alarms,
        misses,
        id_switches,
        fragments,
        ..
    } = scores;
    let f1 = best_f1_pct.or_else(|| {
        let all = 2 * matches + false_alarms + misses;
        (all > 0).then(|| 200.0 * *matches as f64 / all as f64)
    });
    let shares = [
        f1,
        scores.moda_pct,
        scores.modp_pct,
        scores.mota_pct,
        scores.idf1_pct,
        scores.hota_pct,
        scores.deta_pct,
        scores.assa_pct,
        scores.loca_pct,
    ];
    let named = [name.to_owned(), format!("{:.3}", scores.threshold)];
    named
        .into_iter()
        .chain(shares.map(percent))
        .chain([id_switches, fragments].map(u64::to_string))
        .collect()
}

/// A share in percent; a dash without a value.
pub(crate) fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".into(), |share| format!("{share:.2}"))
}
