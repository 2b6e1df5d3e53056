//! The kinds of troubles with their remedies, as operators read them.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use ecod::diagnostics::TroubleKind;

#[test]
fn every_kind_has_a_remedy() {
    let remedies: String = TroubleKind::ALL
        .iter()
        .map(|kind| format!("{}: {}\n", kind.as_str(), kind.remedy()))
        .collect();
    insta::assert_snapshot!(remedies);
}
