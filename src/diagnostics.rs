//! Current troubles of a node and of the vehicles that it receives: each with its cause and its
//! remedy.
//!
//! The parts of a node report their observations to a [`TroubleRegister`] repeatedly while a
//! trouble lasts. The register keeps a bounded number of entries, drops those that are over, and
//! returns new troubles for the log. `docs/troubleshooting.md` lists all kinds.

mod expected_nodes;

use std::collections::BTreeMap;
use std::time::Duration;

use crate::model::names::{MAX_NAME_BYTES, plain_text, vehicle_of};
use crate::model::time::Timestamp;
use crate::wire::{MAX_TROUBLE_TEXT, MAX_TROUBLES, Trouble};

pub use expected_nodes::{ExpectedNodes, MISSING_TIMEOUT, MissingNode};

/// Defines the kinds with their names on the wire, how long they count after they were last seen,
/// and their remedies.
macro_rules! trouble_kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal, $lasts:expr, $remedy:literal;)*) => {
        /// A kind of trouble.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum TroubleKind {
            $($(#[$doc])* $kind,)*
        }

        impl TroubleKind {
            /// All kinds in order of declaration.
            pub const ALL: &'static [Self] = &[$(Self::$kind),*];

            /// Name on the wire and on the page, such as `clock_off`; later versions keep it.
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)*
                }
            }

            /// Advice to the operator, without a capital letter and a full stop.
            pub fn remedy(self) -> &'static str {
                match self {
                    $(Self::$kind => $remedy,)*
                }
            }

            /// Time for which a trouble counts after it was last seen.
            fn lasts(self) -> Duration {
                match self {
                    $(Self::$kind => $lasts,)*
                }
            }
        }
    };
}

/// For troubles observed with every report.
const SHORT: Duration = Duration::from_secs(10);
/// For troubles observed with greetings, which are rare once a cell is complete, and with attempts
/// to connect.
const LONG: Duration = Duration::from_secs(60);
/// For troubles that last until the reporting part settles them.
const UNTIL_SETTLED: Duration = Duration::MAX;

trouble_kinds! {
    /// The leader does not use this node's reports.
    ReportsRefused = "reports_refused", SHORT, "follow the remedy that the leader states";
    /// Reports whose times cannot be used.
    Untimely = "untimely", SHORT, "run a time service where its reports are made, such as chrony";
    /// A clock differs from the cell's time by seconds.
    ClockOff = "clock_off", SHORT, "run a time service on it, such as chrony";
    /// The camera delivers no frames.
    Camera = "camera", UNTIL_SETTLED, "`ecod-node doctor` tries the camera and names what is missing";
    /// The camera stamps its frames by a wrong clock.
    CameraClock = "camera_clock", SHORT, "set the camera's clock by NTP, or state the delay of its frames in `camera.source.latency_s`";
    /// The detector takes longer for a frame than reports are accepted.
    DetectorSlow = "detector_slow", UNTIL_SETTLED, "use smaller frames, another model or a faster machine";
    /// The pose of the camera is unavailable, so the detections in its frames cannot be placed.
    NoPose = "no_pose", SHORT, "send poses to `pose.listen`, or set `pose`; `origin` if they are on Earth";
    /// Detections of a label that has no size.
    NoSize = "no_size", SHORT, "set the label's size in `camera.projection.sizes.labels`, or `camera.mount.height_m` to range it by the ground";
    /// All detections lack a place.
    NotPlaced = "not_placed", SHORT, "let the camera see whole objects, or correct `camera.mount` and `camera.projection`";
    /// The camera points in another direction than its mount states.
    MountMismatch = "mount_mismatch", SHORT, "measure `camera.mount` again, as by `ecod-node calibrate mount`, or correct the sizes of the objects that it sees";
    /// A size in another unit than metres.
    ImplausibleSize = "implausible_size", UNTIL_SETTLED, "sizes are in metres: correct `camera.projection.sizes`";
    /// Another value that looks as if it were in another unit.
    ImplausibleUnit = "implausible_unit", UNTIL_SETTLED, "correct it in this node's configuration or the cell's description; if it is meant so, leave it";
    /// Vehicles name landmarks, but the aggregator has no landmarks.
    NoLocations = "no_locations", SHORT, "give this node the cell's `landmarks`, or the cell a description: `ecod-node cell set`";
    /// A vehicle names a landmark that the aggregator does not have.
    UnknownLocation = "unknown_location", SHORT, "give all nodes the same `landmarks`: `ecod-node cell set`";
    /// Objects at impossible places.
    Misplaced = "misplaced", SHORT, "positions are in metres in the cell's frame: correct its pose, its program or the list of locations";
    /// Objects that coincide with the objects of others after a turn or a mirror.
    Orientation = "orientation", SHORT, "check its pose and axes: headings count counter-clockwise from east, y points north; degrees clockwise from north belong in `azimuth_deg`, `--azimuth` or `Pose.from_compass`";
    /// The node does not use the cell's description.
    Description = "description", UNTIL_SETTLED, "`ecod-node cell diff` shows the difference";
    /// Messages that cannot be read.
    Malformed = "malformed", SHORT, "correct the program that sends them; docs/protocol.md has the fields and limits";
    /// Other messages than reports that are not used.
    MessageRefused = "message_refused", SHORT, "run one version of `ecod-node` on all nodes, each with the cell's key and a certificate of its own";
    /// Reports for an algorithm that the cell does not run.
    NotFused = "not_fused", SHORT, "set `fusion.algorithms` to what the cell is for, or report for the other algorithm";
    /// Messages beyond the rights of their sender, or without a signature that is due.
    NotPermitted = "not_permitted", SHORT, "report at the sender's own node, or give it the cell's key and a certificate of its own name and role";
    /// More messages than are accepted.
    Overload = "overload", SHORT, "send less often, or raise `mqtt.max_report_hz` or `broker.max_messages_hz`; for more vehicles `fusion.window.max_vehicles`";
    /// The connection of a client to this node's broker stands still in both directions.
    NetworkCut = "network_cut", LONG, "check the network between both, and whether its machine runs";
    /// A node of this cell with another key.
    WrongKey = "wrong_key", LONG, "copy the file of `membership.key_file` from one node to all";
    /// A node of a cell whose name is nearly this one's.
    OtherCell = "other_cell", LONG, "give both nodes the same `cell`, if they belong together";
    /// A node that cannot show a certificate which this one accepts.
    NotAdmitted = "not_admitted", LONG, "give it a certificate of the cell (`ecod-node pki issue`), or set the clock";
    /// The node's own certificate ends soon, or has ended, and is not renewed.
    CertificateEnds = "certificate_ends", UNTIL_SETTLED, "start a node that has the CA in `pki` beside its `tls.ca`, or create a new certificate by `ecod-node pki issue`, and copy its two files here: no restart";
    /// The CA of the cell ends soon, or has ended.
    CaEnds = "ca_ends", UNTIL_SETTLED, "give the cell a new CA: docs/security.md, key rotation";
    /// A second running node of a name.
    NameTaken = "name_taken", LONG, "give one of the two another `name`, or stop it";
    /// A former member does not answer, without an orderly stop and without a dismissal by an operator.
    NodeMissing = "node_missing", SHORT, "start it again; if it does not come back, `ecod-node cell dismiss` with its name ends this";
    /// An unanswered seed at a node that has discovered no other member.
    SeedSilent = "seed_silent", LONG, "start it, give both nodes the same `cell` and key, or let UDP through; without such a node, remove it from `membership.seeds`";
    /// A host name without an address.
    Unresolved = "unresolved", LONG, "correct the name, or the name service of this machine";
    /// A broker that cannot be reached.
    BrokerUnreachable = "broker_unreachable", LONG, "check its address, the firewall, the certificates on both sides, and whether the broker runs";
    /// A broker that refuses a necessary operation of this node.
    BrokerRefuses = "broker_refuses", UNTIL_SETTLED, "check password, certificate and permissions";
    /// The region's broker cannot be reached.
    UplinkUnreachable = "uplink_unreachable", LONG, "check the link to the region, and whether its broker runs; the cell works without the region";
    /// An uplink of a cell that has no place on Earth.
    NoOrigin = "no_origin", UNTIL_SETTLED, "set `[origin]` in the cell's description: `ecod-node cell set`";
    /// A cell to which the vehicle cannot move.
    CellLeftOut = "cell_left_out", UNTIL_SETTLED, "correct its entry in the file of `cells` and the files that it names: `ecod-node doctor` tries all";
    /// More troubles than are kept.
    NotShown = "not_shown", SHORT, "correct the troubles that are shown; others then appear";
    /// Entries that are missing in the log.
    NotRecorded = "not_recorded", SHORT, "free space on the disk of `record.dir`, and make the directory writable for the node's user";
    /// State that cannot be saved.
    NotSaved = "not_saved", UNTIL_SETTLED, "free space on the disk, and make `state_dir` writable for the node's user";
}

impl TroubleKind {
    /// The kind of a name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.as_str() == name)
    }

    /// True if the trouble is recorded for each message, so that its rate is meaningful.
    fn is_counted(self) -> bool {
        matches!(
            self,
            Self::Malformed
                | Self::MessageRefused
                | Self::NotFused
                | Self::NotPermitted
                | Self::Overload
        )
    }

    /// True if a host can cause it under any name or from any address, without proof of the cell's
    /// key or of the name.
    fn is_of_strangers(self) -> bool {
        matches!(self, Self::WrongKey | Self::OtherCell | Self::NotAdmitted)
    }

    /// True if an aggregator with this trouble about a vehicle does not use the vehicle's reports.
    pub fn refuses_reports(self) -> bool {
        matches!(self, Self::Untimely | Self::Malformed | Self::NotPermitted)
    }

    /// True if a node's report of this trouble about another node is shown on the pages of all
    /// nodes, because the others may lack the observation.
    pub fn is_shared(self) -> bool {
        self == Self::NodeMissing || self.is_separating()
    }

    /// True if a node with this trouble cannot do its work.
    pub fn is_disabling(self) -> bool {
        matches!(
            self,
            Self::ReportsRefused | Self::Camera | Self::DetectorSlow | Self::NoPose
        )
    }

    /// True if this trouble, of any host, may be the reason why a node finds no leader or gets no
    /// rounds.
    pub fn is_separating(self) -> bool {
        matches!(
            self,
            Self::WrongKey
                | Self::OtherCell
                | Self::NotAdmitted
                | Self::NameTaken
                | Self::SeedSilent
                | Self::Unresolved
                | Self::BrokerUnreachable
                | Self::BrokerRefuses
        )
    }
}

/// Minimum time between two lines of the log about the same trouble.
const LOG_INTERVAL: Duration = Duration::from_secs(3600);

/// The same interval for another cause of the trouble.
const NEW_CAUSE_INTERVAL: Duration = Duration::from_secs(60);

/// Minimum time between two updates of a cause's figures, and of the text of causes that any
/// message may produce.
const TEXT_INTERVAL: Duration = Duration::from_secs(10);

/// Maximum number of stored troubles: about one vehicle with its parts or one host, of kinds that
/// hosts can cause under any name, and about all nodes other than this one.
const MAX_ABOUT_ONE: usize = 4;
const MAX_OF_STRANGERS: usize = 3;
const MAX_ABOUT_OTHERS: usize = MAX_TROUBLES - 4;

/// Identity of a trouble in the register.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct TroubleKey {
    /// The subject; `None` for the node itself.
    about: Option<String>,
    kind: TroubleKind,
}

/// The current troubles of a node.
#[derive(Debug, Clone, Default)]
pub struct TroubleRegister {
    /// A lapsed entry stays until its room is needed, so that a trouble that comes and goes is not
    /// logged each time.
    entries: BTreeMap<TroubleKey, KnownTrouble>,
}

#[derive(Debug, Clone)]
struct KnownTrouble {
    shown: Trouble,
    shown_at: Timestamp,
    /// The displayed cause and the logged cause, without their figures.
    gist: String,
    logged_gist: String,
    /// Number of times that it was seen since it is shown.
    times: u64,
    seen_at: Timestamp,
    logged_at: Timestamp,
    is_settled: bool,
}

impl KnownTrouble {
    fn is_present(&self, kind: TroubleKind, now: Timestamp) -> bool {
        !self.is_settled && now.since(self.seen_at) < kind.lasts()
    }
}

impl TroubleRegister {
    /// Records a trouble of the node itself, or about another; returns it if it is news for the
    /// log.
    pub fn record(
        &mut self,
        kind: TroubleKind,
        about: Option<&str>,
        cause: &str,
        now: Timestamp,
    ) -> Option<Trouble> {
        self.record_with(kind, about, || cause.to_owned(), kind.remedy(), now)
    }

    /// Records a trouble with a remedy that another node may have supplied. The text of the cause
    /// is only requested when it is needed.
    pub fn record_with(
        &mut self,
        kind: TroubleKind,
        about: Option<&str>,
        cause: impl FnOnce() -> String,
        remedy: &str,
        now: Timestamp,
    ) -> Option<Trouble> {
        let key = key(kind, about);
        let shown = |cause: &str, suffix: &str| Trouble {
            kind: kind.as_str().into(),
            about: key.about.clone(),
            cause: shortened(cause, MAX_TROUBLE_TEXT - suffix.len()) + suffix,
            remedy: shortened(remedy, MAX_TROUBLE_TEXT),
        };
        if let Some(entry) = self.entries.get_mut(&key) {
            entry.times += 1;
            let is_present = entry.is_present(kind, now);
            let age = now.since(entry.shown_at);
            entry.seen_at = now;
            entry.is_settled = false;
            let is_due = !is_present || age >= TEXT_INTERVAL;
            if is_due || !kind.is_counted() {
                let cause = cause();
                let gist = gist(&cause);
                if is_due || gist != entry.gist {
                    let per_second = if is_present && kind.is_counted() {
                        entry.times / age.as_secs().max(1)
                    } else {
                        0
                    };
                    let rate = if per_second > 0 {
                        format!(", {per_second} a second")
                    } else {
                        String::new()
                    };
                    entry.shown = shown(&cause, &rate);
                    entry.shown_at = now;
                    entry.gist = gist;
                    entry.times = 0;
                }
            }
            let interval = if entry.gist == entry.logged_gist {
                LOG_INTERVAL
            } else {
                NEW_CAUSE_INTERVAL
            };
            return (now.since(entry.logged_at) >= interval).then(|| {
                entry.logged_at = now;
                entry.logged_gist = entry.gist.clone();
                entry.shown.clone()
            });
        }
        if !self.make_room(&key, now) {
            let about = key.about.unwrap_or_default();
            let kind = kind.as_str();
            let cause =
                format!("there are more troubles than have room here, such as {kind} of {about}");
            return self.record(TroubleKind::NotShown, None, &cause, now);
        }
        let cause = cause();
        let entry = KnownTrouble {
            shown: shown(&cause, ""),
            shown_at: now,
            gist: gist(&cause),
            logged_gist: gist(&cause),
            times: 0,
            seen_at: now,
            logged_at: now,
            is_settled: false,
        };
        let news = entry.shown.clone();
        self.entries.insert(key, entry);
        Some(news)
    }

    /// Records that a trouble is over.
    pub fn settle(&mut self, kind: TroubleKind, about: Option<&str>) {
        if let Some(entry) = self.entries.get_mut(&key(kind, about)) {
            entry.is_settled = true;
        }
    }

    /// Records that all troubles of a kind are over, for all subjects.
    pub fn settle_all(&mut self, kind: TroubleKind) {
        let of_kind = self.entries.iter_mut().filter(|(key, _)| key.kind == kind);
        of_kind.for_each(|(_, entry)| entry.is_settled = true);
    }

    /// The current troubles: the node's own first, then by vehicle or host.
    pub fn present(&self, now: Timestamp) -> Vec<Trouble> {
        self.entries
            .iter()
            .filter(|(key, entry)| entry.is_present(key.kind, now))
            .map(|(_, entry)| entry.shown.clone())
            .take(MAX_TROUBLES)
            .collect()
    }

    /// True if there is room for one more entry. Lapsed entries of the same group are removed if
    /// necessary, the longest unseen first.
    fn make_room(&mut self, key: &TroubleKey, now: Timestamp) -> bool {
        if key.about.is_none() {
            return true;
        }
        let vehicle = key.about.as_deref().map(vehicle_of);
        let is_of_vehicle = |other: &TroubleKey| {
            other.about.as_deref().map(vehicle_of) == vehicle && !other.kind.is_of_strangers()
        };
        let has_share = if key.kind.is_of_strangers() {
            self.make_room_in(MAX_OF_STRANGERS, now, |other| other.kind.is_of_strangers())
        } else {
            self.make_room_in(MAX_ABOUT_ONE, now, is_of_vehicle)
        };
        has_share && self.make_room_in(MAX_ABOUT_OTHERS, now, |other| other.about.is_some())
    }

    /// The same check for one group of at most `most` entries.
    fn make_room_in(
        &mut self,
        most: usize,
        now: Timestamp,
        is_in: impl Fn(&TroubleKey) -> bool,
    ) -> bool {
        while self.entries.keys().filter(|key| is_in(key)).count() >= most {
            let lapsed = self
                .entries
                .iter()
                .filter(|(key, entry)| is_in(key) && !entry.is_present(key.kind, now));
            let oldest = lapsed.min_by_key(|(_, entry)| entry.seen_at);
            let Some(key) = oldest.map(|(key, _)| key.clone()) else {
                return false;
            };
            self.entries.remove(&key);
        }
        true
    }
}

fn key(kind: TroubleKind, about: Option<&str>) -> TroubleKey {
    let name = |about| match plain_text(about, MAX_NAME_BYTES) {
        name if name.is_empty() => "without a name".to_owned(),
        name => name,
    };
    TroubleKey {
        about: about.map(name),
        kind,
    }
}

/// A text of at most `max_bytes` bytes, with an ellipsis after the last whole word if it is longer.
fn shortened(text: &str, max_bytes: usize) -> String {
    const ELLIPSIS: &str = " …";
    if text.len() <= max_bytes {
        return plain_text(text, max_bytes);
    }
    let cut = plain_text(text, max_bytes - ELLIPSIS.len());
    cut.rsplit_once(' ')
        .map_or(&*cut, |(words, _)| words)
        .to_owned()
        + ELLIPSIS
}

/// A duration in words: whole seconds, minutes or hours.
pub fn in_words(time: Duration) -> String {
    match time.as_secs() {
        seconds @ 0..120 => format!("{seconds} s"),
        seconds @ 120..7200 => format!("{} min", seconds / 60),
        seconds => format!("{} h", seconds / 3600),
    }
}

/// A cause without its figures.
fn gist(cause: &str) -> String {
    cause
        .chars()
        .filter(|letter| !letter.is_ascii_digit() && !matches!(letter, '.' | '-'))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000;

    fn at(s: u64) -> Timestamp {
        Timestamp(s * SECOND)
    }

    fn shown(register: &TroubleRegister, now: Timestamp) -> Vec<String> {
        let text =
            |trouble: Trouble| format!("{}: {}", trouble.about.unwrap_or_default(), trouble.cause);
        register.present(now).into_iter().map(text).collect()
    }

    #[test]
    fn trouble_is_logged_hourly() {
        let mut register = TroubleRegister::default();
        let mut lines = 0;
        for s in 0..7300 {
            let news = register.record(
                TroubleKind::Malformed,
                Some("watson"),
                &format!("{s} reports"),
                at(s),
            );
            lines += usize::from(news.is_some());
        }
        assert_eq!(lines, 3);
        assert_eq!(
            shown(&register, at(7300)),
            ["watson: 7290 reports, 1 a second"],
            "words change every ten seconds"
        );
        assert!(register.present(at(7310)).is_empty());
        assert!(
            register
                .record(
                    TroubleKind::Malformed,
                    Some("watson"),
                    "9 reports",
                    at(7400)
                )
                .is_none()
        );
        assert_eq!(
            shown(&register, at(7400)),
            ["watson: 9 reports"],
            "it is back, and was logged within the hour"
        );
    }

    #[test]
    fn long_cause_ends_at_word() {
        let mut register = TroubleRegister::default();
        register.record(
            TroubleKind::ImplausibleSize,
            None,
            &"`camera.projection` is 180 ".repeat(20),
            at(1),
        );
        let [cause] = shown(&register, at(1)).try_into().unwrap();
        assert!(
            cause.ends_with(" …") && cause.len() <= MAX_TROUBLE_TEXT + 2,
            "{cause}"
        );
        let last = cause.trim_end_matches(" …").rsplit(' ').next();
        assert!(
            ["`camera.projection`", "is", "180"]
                .map(Some)
                .contains(&last),
            "{cause}"
        );
    }

    #[test]
    fn lasting_trouble_ends_when_settled() {
        let mut register = TroubleRegister::default();
        assert!(
            register
                .record(TroubleKind::Camera, None, "no frame for 5 s", at(1))
                .is_some()
        );
        assert_eq!(register.present(at(100_000)).len(), 1);
        register.settle(TroubleKind::Camera, None);
        assert!(register.present(at(100_000)).is_empty());
    }

    /// Names come from outside: a host that invents names displaces the entries of neither this
    /// node nor other nodes.
    #[test]
    fn invented_names_displace_no_troubles() {
        let mut register = TroubleRegister::default();
        register.record(
            TroubleKind::ClockOff,
            Some("gauss"),
            "its clock is 5.0 s ahead",
            at(0),
        );
        for n in 0..1000 {
            register.record(
                TroubleKind::Malformed,
                Some(&format!("v{n}")),
                "a\nb\u{202E}",
                at(0),
            );
        }
        register.record(TroubleKind::Camera, None, "no frame", at(1));
        let present = register.present(at(1));
        assert_eq!(present.len(), MAX_ABOUT_OTHERS + 2);
        let own = present
            .iter()
            .take(2)
            .map(|own| (own.kind.as_str(), own.about.as_deref()));
        assert_eq!(
            own.collect::<Vec<_>>(),
            [("camera", None), ("not_shown", None)]
        );
        assert_eq!(present[2].about.as_deref(), Some("gauss"));
        assert_eq!(present[3].cause, "a b ");
        register.record(TroubleKind::Malformed, Some("late"), "x", at(60));
        assert_eq!(
            shown(&register, at(60)),
            [": no frame", "late: x"],
            "ended troubles are evicted"
        );
    }

    #[test]
    fn vehicle_parts_leave_room() {
        let mut register = TroubleRegister::default();
        for part in 0..100 {
            for kind in [TroubleKind::Malformed, TroubleKind::Misplaced] {
                register.record(kind, Some(&format!("mallory--{part}")), "x", at(0));
            }
        }
        assert_eq!(register.present(at(0)).len(), MAX_ABOUT_ONE + 1);
        assert!(
            register
                .record(TroubleKind::Malformed, Some("watson"), "x_m is NaN", at(0))
                .is_some()
        );
    }

    #[test]
    fn strangers_leave_room_for_members() {
        let mut register = TroubleRegister::default();
        let lines = (0..100).filter(|host| {
            let about = format!("10.0.0.{host}");
            register
                .record(
                    TroubleKind::WrongKey,
                    Some(&about),
                    "received with another key",
                    at(0),
                )
                .is_some()
        });
        assert_eq!(
            lines.count(),
            MAX_OF_STRANGERS + 1,
            "the last line states that there are more"
        );
        assert!(
            register
                .record(TroubleKind::Malformed, Some("watson"), "x_m is NaN", at(0))
                .is_some()
        );
        assert_eq!(register.present(at(0)).len(), MAX_OF_STRANGERS + 2);
    }

    #[test]
    fn claimed_names_leave_vehicle_its_share() {
        let mut register = TroubleRegister::default();
        for part in 0..100 {
            register.record(
                TroubleKind::NotAdmitted,
                Some(&format!("watson--{part}")),
                "its certificate is of another name",
                at(0),
            );
        }
        assert!(
            register
                .record(TroubleKind::Malformed, Some("watson"), "x_m is NaN", at(0))
                .is_some()
        );
    }

    #[test]
    fn changed_cause_is_shown_immediately() {
        let mut register = TroubleRegister::default();
        register.record(
            TroubleKind::BrokerRefuses,
            Some("hub:1883"),
            "wrong password",
            at(0),
        );
        let mut note = |s| {
            register.record(
                TroubleKind::BrokerRefuses,
                Some("hub:1883"),
                "certificate expired",
                at(s),
            )
        };
        assert!(note(1).is_none());
        assert_eq!(note(60).unwrap().cause, "certificate expired");
        assert!(note(200).is_none(), "once");
        assert_eq!(shown(&register, at(1)), ["hub:1883: certificate expired"]);
    }

    #[test]
    fn any_named_trouble_is_settled() {
        for about in ["", "a".repeat(200).as_str(), "a\u{202E}b"] {
            let mut register = TroubleRegister::default();
            register.record(TroubleKind::BrokerRefuses, Some(about), "refused", at(0));
            assert!(
                register.present(at(0))[0].about.is_some(),
                "it is not the node's own"
            );
            register.settle(TroubleKind::BrokerRefuses, Some(about));
            assert!(register.present(at(0)).is_empty());
        }
    }

    #[test]
    fn every_kind_is_documented() {
        let manual = include_str!("../docs/troubleshooting.md");
        let testing = include_str!("../TESTING.md");
        let (_, tests) = testing.split_once("| kind | test |").unwrap();
        for kind in TroubleKind::ALL {
            assert!(
                manual.contains(&format!("\n| `{}` |", kind.as_str())),
                "{kind:?}"
            );
            assert!(
                tests
                    .lines()
                    .any(|row| row.contains(&format!("`{}`", kind.as_str()))),
                "no test makes {kind:?}"
            );
            assert_eq!(TroubleKind::named(kind.as_str()), Some(*kind));
            assert!(
                (10..MAX_TROUBLE_TEXT).contains(&kind.remedy().len()),
                "{kind:?}"
            );
        }
    }
}
