//! The core as its users call it: fusion by PACE, tracking, VOTE, and the program that the README shows.

mod accepted_by_receivers;
mod examples;
mod moving_on;
mod pace;
mod tracks;
mod vote;
