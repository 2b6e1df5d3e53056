//! What a new leader goes on from.

use std::collections::BTreeMap;

use ecod::aggregator::FusionConfig;
use ecod::leadership::{Leadership, Position};
use ecod::model::names::NodeName;
use ecod::wire::SCHEMA_VERSION;

use super::*;
use crate::actors::follower::{Follower, FollowerArguments};
use crate::messages::actor_slot::listening;
use crate::messages::follower::FollowerMessage;
use crate::messages::newest::Newest;

fn epoch(term: u64, leader: &'static str) -> Epoch {
    Epoch::new(term, NodeName::from_static(leader))
}

fn global_map(Epoch { term, leader }: Epoch, round: u64) -> Arc<GlobalMap> {
    Arc::new(GlobalMap {
        schema: SCHEMA_VERSION,
        aggregator: leader,
        epoch: term,
        round,
        fused_at_us: Timestamp(0),
        oldest_capture_us: None,
        landmarks: Vec::new(),
        objects: Vec::new(),
        pose_corrections: BTreeMap::new(),
    })
}

fn spans() -> Spans {
    Spans::new(NodeName::from_static("lot"), NodeName::from_static("gauss"))
}

fn map(epoch: Epoch, round: u64, received_at: Timestamp) -> FollowerMessage {
    let map = global_map(epoch, round);
    FollowerMessage::TakeMap { delivery: Delivery::local(map, received_at) }
}

fn standby() -> FuserState {
    FuserState::new(FuserArguments {
        aggregator: Aggregator::new_standby(FusionConfig::default(), Vec::new(), Timestamp(0)),
        report_queue: LatestReportQueue::default(),
        newest: None,
        recording: LogSender::default(),
        clock: CellClock::default(),
        gateway: ActorSlot::default(),
        keeper: ActorSlot::default(),
        counters: Arc::default(),
        spans: spans(),
    })
}

#[tokio::test]
async fn a_forged_map_neither_keeps_the_leaders_out_nor_takes_their_place() {
    let elected = Leadership {
        position: Position::Following,
        epoch: Some(epoch(7, "edge")),
        standby: None,
        term: 7,
        is_deserted: false,
        is_yielding: false,
    };
    let seeking = Leadership { term: 7, ..Leadership::default() };
    for leadership in [elected, seeking] {
        let ((fuser, mut told), newest) = (listening::slot().await, Newest::default());
        let arguments = FollowerArguments {
            newest: newest.clone(),
            log: None,
            recording: LogSender::default(),
            saved_term: 0,
            leadership: tokio::sync::watch::channel(leadership.clone()).1,
            election: ActorSlot::default(),
            fuser: fuser.clone(),
            door: Default::default(),
            clock: CellClock::default(),
            counters: Arc::default(),
            spans: spans(),
        };
        let (follower, _) = Actor::spawn(None, Follower, arguments).await.unwrap();
        for round in 1..=3 {
            follower.cast(map(epoch(7, "edge"), round, Timestamp(round))).unwrap();
            follower.cast(map(epoch(u64::MAX, "gauss"), round, Timestamp(round))).unwrap();
        }
        // The filter believes who goes on publishing; a new leader does not go on from that.
        follower.cast(map(epoch(u64::MAX, "gauss"), 4, Timestamp(600_000))).unwrap();
        follower.drain_and_wait(None).await.unwrap();
        fuser.get().unwrap().drain_and_wait(None).await.unwrap();

        let mut fuser = standby();
        let mut maps = 0;
        while let Ok(FuserMessage::TakeMap { map, received_at }) = told.try_recv() {
            fuser.take_map(map, received_at);
            maps += 1;
        }
        assert_eq!(newest.map.borrow().as_ref().map(|newest| newest.map.epoch), Some(u64::MAX));
        let kept = fuser.last_map.map(|(map, _)| (map.epoch, map.round));
        assert_eq!((kept, maps), (Some((7, 3)), 3), "{leadership:?}");
    }
}

#[tokio::test]
async fn a_new_leader_goes_on_from_no_map_of_a_node_that_is_not_trusted_any_more() {
    let mut fuser = standby();
    let FollowerMessage::TakeMap { delivery } = map(epoch(7, "edge"), 1, Timestamp(1)) else { panic!("a map") };
    fuser.take_map(Arc::clone(&delivery.message), Timestamp(1));
    fuser.forget_map(&NodeName::from_static("gauss"));
    assert!(fuser.last_map.is_some(), "another's");
    fuser.forget_map(&NodeName::from_static("edge"));
    assert!(fuser.last_map.is_none());
}
