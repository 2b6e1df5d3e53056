use super::*;

/// Frame, identity, label, score and position.
type Row<'a> = (u64, Option<i64>, &'a str, f64, f64, f64);

fn positions(frames: &Frames) -> Vec<Row<'_>> {
    let flat = frames.iter().flat_map(|(frame, objects)| objects.iter().map(move |object| (*frame, object)));
    flat.map(|(frame, o)| (frame, o.id, o.label.as_str(), o.score, o.position.x, o.position.y)).collect()
}

#[test]
fn kittis_labels_and_results_are_in_the_frame_of_the_vehicle() {
    let text = "0 -1 DontCare -1 -1 -10 219.3 188.5 245.5 218.6 -1000 -1000 -1000 -10 -1 -1 -1\n\
                0 2 Van 0 0 -1.7 296.7 161.7 455.2 292.3 2.0 1.8 4.4 -4.5 1.8 13.4 -2.1\n\
                0 3 Car 0 0 -1.7 296.7 161.7 455.2 292.3 1.5 1.6 3.9 -4.5 1.8 13.4 -2.1\n\n\
                2 3 Car 0 0 -1.7 296.7 161.7 455.2 292.3 1.5 1.6 3.9 -4.0 1.8 14.0 -2.1 0.7\n";
    let frames = FileFormat::Kitti.parse(text).unwrap();
    assert_eq!(
        positions(&frames),
        [(0, Some(3), "Car", 1.0, 13.4, 4.5), (2, Some(3), "Car", 0.7, 14.0, 4.0)],
        "left is positive, and classes that are not judged are left out"
    );
}

#[test]
fn scores_of_detectors_become_probabilities_in_the_same_order() {
    let line = |frame: u32, kind: u32, score: f64| {
        format!("{frame},{kind},1,2,3,4,{score},1.5,1.6,3.9,2.9,1.6,6.4,-1.5,-2.0\n")
    };
    let text = line(0, 2, 0.0) + &line(0, 1, 12.0) + &line(4, 3, -0.8);
    let frames = FileFormat::Kitti.parse(&text).unwrap();
    let found = positions(&frames);
    assert_eq!(found[0], (0, None, "Car", 0.5, 6.4, -2.9));
    assert!((found[1].2, found[2].2) == ("Pedestrian", "Cyclist") && found[1].3 > 0.99 && found[2].3 < 0.5);
}

#[test]
fn positions_of_mot_challenge_are_those_on_the_ground() {
    let text = "1,-1,912,484,97,109,0.5,3.5,-2.25,0\n2,7,912,484,97,109,1,4,5,0\n2,8,912,484,97,109,0,4,5,0\n";
    let frames = FileFormat::Mot.parse(text).unwrap();
    assert_eq!(positions(&frames), [(1, None, "person", 0.5, 3.5, -2.25), (2, Some(7), "person", 1.0, 4.0, 5.0)]);
}

#[test]
fn line_and_field_of_what_cannot_be_read_are_named() {
    for (format, text, fault) in [
        (FileFormat::Kitti, "\n0 3 Car 0 0", "line 2: column 16 (z): is missing, there are 5 columns"),
        (FileFormat::Kitti, "-1 3 Car", "line 1: column 1 (frame): -1 is out of bounds"),
        (FileFormat::Kitti, "0 x Car", "line 1: column 2 (track): \"x\" is no number"),
        (FileFormat::Kitti, "0,9,1,2,3,4,5", "line 1: column 2 (type): 9 is none of 1 to 3"),
        (FileFormat::Kitti, "0,2,1,2,3,4,nan,1,1,1,1,1,1", "line 1: column 7 (score): \"nan\" is no number"),
        (FileFormat::Mot, "1.5,1,1,2,3,4,1,1,1,1", "line 1: column 1 (frame): 1.5 is no whole number"),
        (FileFormat::Mot, "1,1,1,2,3,4,1,1,1", "line 1: column 8 (x): is no position on the ground"),
        (FileFormat::Mot, "1,1,1,2,3,4,1,-1,-1,-1", "line 1: column 8 (x): -1 is no position on the ground"),
    ] {
        let said = format.parse(text).unwrap_err().to_string();
        assert!(said.starts_with(fault), "{text}: {said}");
    }
}
