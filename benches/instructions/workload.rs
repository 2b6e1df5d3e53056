//! What is counted: the state right before the call that is measured.

use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::election::{
    Body, Candidacy, Election, ElectionConfig, ElectionInput, ElectionMessage, Health, LifeSign,
};
use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::epoch::Epoch;
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::pace::{Pace, PaceConfig};
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::landmark::{Landmark, LandmarkIndex};
use ecod::perception::projection::{
    ObjectSize, ObjectSizes, Projection, ProjectionConfig, Ranging,
};
use ecod::reputation::ReputationConfig;
use ecod::tracking::{Tracker, TracksConfig};
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, Role, SCHEMA_VERSION, WirePose, encode};
use nalgebra::Point2;

const NOON: Timestamp = Timestamp(1_732_154_400_000_000);
const VEHICLES: usize = 32;
const OBJECTS: usize = 32;
const LANDMARKS: usize = 256;

/// A thousand boxes, and what places them.
pub struct Boxes {
    /// Projection of the camera that detected the boxes.
    pub projection: Projection,
    /// Pose of the camera.
    pub camera: Pose,
    /// The boxes as detections, in pixels.
    pub detections: Vec<Detection>,
}

/// An algorithm after some rounds, and the reports of the next round.
pub struct Round<A, R> {
    /// The algorithm, which is measured from this state on.
    pub algorithm: A,
    /// One report of each vehicle.
    pub reports: Vec<R>,
    /// Time of the round.
    pub now: Timestamp,
}

/// An encoded report and its sender.
pub struct Payload {
    /// The report in the encoding that is measured.
    pub bytes: Vec<u8>,
    /// The node whose report it is.
    pub node: NodeName,
}

/// A node that follows a leader, and the leader's next beat.
pub struct Following {
    /// Election of the follower.
    pub election: Election,
    /// The beat as the follower receives it.
    pub beat: ElectionInput,
    /// Time of the beat.
    pub now: Timestamp,
}

/// A thousand boxes, and what places them.
pub fn boxes() -> Boxes {
    let intrinsics =
        Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
    let size = ObjectSize {
        width_m: 1.8,
        height_m: 1.5,
        length_m: None,
        relative_sigma: 0.05,
    };
    let sizes = ObjectSizes {
        labels: [("car".into(), size)].into(),
        default: Some(size),
    };
    let config = ProjectionConfig {
        ranging: Ranging::BoxHeight,
        sizes,
        ..ProjectionConfig::default()
    };
    Boxes {
        projection: Projection::new(config, intrinsics, Mount::default()),
        camera: Pose::new(0.6, 0.5, 2.9),
        detections: (0..1000).map(detection).collect(),
    }
}

fn detection(index: usize) -> Detection {
    let x_min = 10.0 + (index % 500) as f64;
    let y_min = 100.0 + (index % 97) as f64;
    let width = 20.0 + (index % 80) as f64;
    let height = 30.0 + (index % 60) as f64;
    Detection {
        label: "car".into(),
        confidence: 0.5 + (index % 50) as f64 / 100.0,
        bounding_box: BoundingBox {
            x_min,
            y_min,
            x_max: x_min + width,
            y_max: y_min + height,
        },
        corners: None,
    }
}

/// PACE after ten rounds, and the reports of the next: 32 vehicles, 32 objects each, 256 locations.
pub fn pace() -> Round<Pace, ObjectReport> {
    let landmarks = (0..LANDMARKS).map(landmark).collect();
    let config = PaceConfig::default();
    let mut pace = Pace::new(
        config.clone(),
        Arc::new(LandmarkIndex::new(landmarks, config.gate_m)),
    );
    let mut now = NOON;
    for round in 0..10 {
        now = now + Duration::from_millis(100);
        reports(round, now)
            .iter()
            .for_each(|report| pace.observe(report, now));
        pace.close(now);
    }
    now = now + Duration::from_millis(100);
    Round {
        algorithm: pace,
        reports: reports(10, now),
        now,
    }
}

/// Tracks after twenty rounds, and the reports of the next: 32 vehicles, 32 objects each, of 256 that stand nine metres apart.
pub fn tracks() -> Round<Tracker, Arc<ObjectReport>> {
    let mut tracker = Tracker::new(TracksConfig::default(), ReputationConfig::default());
    let apart = |object: PerceivedObject| PerceivedObject {
        landmark: None,
        x_m: 3.0 * object.x_m,
        y_m: 3.0 * object.y_m,
        ..object
    };
    let reports = |round: usize, now: Timestamp| {
        let of_round = reports(round, now).into_iter();
        let unposed = of_round.map(|report| ObjectReport {
            pose: None,
            objects: report.objects.into_iter().map(apart).collect(),
            ..ObjectReport::new(report.node, report.seq, now)
        });
        unposed.map(Arc::new).collect::<Vec<_>>()
    };
    let mut now = NOON;
    for round in 0..20 {
        now = now + Duration::from_millis(100);
        reports(round, now)
            .into_iter()
            .for_each(|report| assert!(tracker.observe(report, now)));
        tracker.close(now);
    }
    now = now + Duration::from_millis(100);
    Round {
        algorithm: tracker,
        reports: reports(20, now),
        now,
    }
}

/// VOTE after ten rounds, and the votes of the next: 32 vehicles, 32 votes each on 256 locations.
pub fn vote() -> Round<Vote, ObjectReport> {
    let mut vote = Vote::new(
        VoteConfig::default(),
        (0..LANDMARKS).map(landmark).collect(),
    );
    let mut now = NOON;
    for round in 0..10 {
        now = now + Duration::from_millis(100);
        for report in reports(round, now) {
            vote.observe(&report, now).expect("reports are in order");
        }
        vote.close(now);
    }
    now = now + Duration::from_millis(100);
    Round {
        algorithm: vote,
        reports: reports(10, now),
        now,
    }
}

/// A report of 32 objects in an encoding, and whose it is.
pub fn payload(encoding: Encoding) -> Payload {
    let report = reports(1, NOON).swap_remove(7);
    Payload {
        bytes: encode(&report, encoding),
        node: report.node,
    }
}

/// A node that follows a leader, and the leader's next beat.
pub fn following() -> Following {
    let mut election = Election::new(
        ElectionConfig::default(),
        NodeName::from_static("euclid"),
        0,
        NOON,
    );
    let health = Health {
        broker: true,
        fuser: true,
        gateway: true,
        reports: true,
        settings: true,
        load_percent: 5,
    };
    election.handle(ElectionInput::Health { health }, NOON);
    election.handle(
        ElectionInput::PeerAlive {
            peer: NodeName::from_static("edge"),
        },
        NOON,
    );
    let mut now = NOON;
    for seq in 1..100 {
        now = now + Duration::from_millis(50);
        election.handle(beat(seq), now);
        election.tick(now);
    }
    assert_eq!(
        election.leader(),
        Some(&NodeName::from_static("edge")),
        "the node follows"
    );
    Following {
        election,
        beat: beat(100),
        now: now + Duration::from_millis(50),
    }
}

fn beat(seq: u64) -> ElectionInput {
    let edge = NodeName::from_static("edge");
    let successors = vec![NodeName::from_static("euclid")];
    let message = ElectionMessage {
        schema: SCHEMA_VERSION,
        from: edge.clone(),
        run: NOON.micros(),
        seq,
        candidacy: Candidacy {
            role: Role::Edge,
            priority: 100,
            load: 1,
            fit: true,
        },
        term: 1,
        epoch: Some(Epoch::new(1, edge)),
        hears_you: true,
        body: Body::Beat {
            every_ms: 50,
            round: seq,
            followers: 1,
            after: None,
            successors,
            life: LifeSign::default(),
        },
        clock: None,
        description: None,
    };
    ElectionInput::Receive { message }
}

fn landmark(index: usize) -> Landmark {
    Landmark {
        id: format!("l{index}").into(),
        position: place(index),
        facing_rad: None,
        vacancy: None,
        synonyms: Vec::new(),
    }
}

fn place(index: usize) -> Point2<f64> {
    Point2::new((index % 16) as f64 * 3.0, (index / 16) as f64 * 3.0)
}

/// Each vehicle sees neighbouring locations, a little off their places; one in ten objects is something else.
fn reports(round: usize, captured_at: Timestamp) -> Vec<ObjectReport> {
    let object = |vehicle: usize, n: usize| {
        let landmark = (vehicle * 8 + n) % LANDMARKS;
        let position = place(landmark);
        let jitter = ((vehicle * 31 + n * 17 + round * 7) % 100) as f64 / 500.0 - 0.1;
        let label = if (vehicle + n + round).is_multiple_of(10) {
            "truck"
        } else {
            "car"
        };
        PerceivedObject {
            covariance_m2: Some([0.01, 0.001, 0.02]),
            landmark: Some(format!("l{landmark}").into()),
            ..PerceivedObject::new(
                label,
                0.5 + ((vehicle + n) % 50) as f64 / 100.0,
                position.x + jitter,
                position.y,
            )
        }
    };
    let report = |vehicle: usize| ObjectReport {
        pose: Some(WirePose::new(0.6, 0.5, 0.8)),
        objects: (0..OBJECTS).map(|n| object(vehicle, n)).collect(),
        ..ObjectReport::new(
            NodeName::new(format!("v{vehicle}")).expect("a valid name"),
            round as u64 + 1,
            captured_at,
        )
    };
    (0..VEHICLES).map(report).collect()
}
