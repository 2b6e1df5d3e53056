//! The core as its users call it: fusion by PACE, tracking, VOTE, replays, and the program that the README shows; and the
//! imports between its modules.

mod accepted_by_receivers;
mod examples;
mod messages;
mod pace;
mod replays;
mod rooms;
mod tracks;
mod troubles;
mod vote;
