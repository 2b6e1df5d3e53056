//! What `ecod-interop --help` and the help of each command print.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use ecod_testkit::help_of;

#[test]
fn every_command_is_described() {
    insta::assert_snapshot!(help_of(env!("CARGO_BIN_EXE_ecod-interop")));
}
