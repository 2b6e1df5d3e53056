//! A town of nine cells keeps identities as one aggregator over everything does.

use ecod_lab::town::{LinkConfig, TownResult, run, town_traffic};
use ecod_lab::traffic::generate;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[test]
fn identity_survives_change_of_cell() {
    let traffic = town_traffic(2, 25.0);
    traffic.validate().unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(4001);
    let recording = generate(&traffic, &mut || rng.random());
    let mut town = |link| run(&traffic, &recording, link, &mut || rng.random()).unwrap();
    let alone = town(LinkConfig {
        is_up: false,
        ..LinkConfig::default()
    });
    let linked = town(LinkConfig {
        map_hz: 2.0,
        ..LinkConfig::default()
    });
    let idf1 = |scores: &ecod_lab::town::TownScores| scores.all.at_best_f1.idf1_pct.unwrap();
    let whole = idf1(&linked.single);
    let linked_idf1 = idf1(&linked.cells);
    let alone_idf1 = idf1(&alone.cells);
    assert!(
        linked_idf1 > whole - 2.0,
        "IDF1 of nine cells {linked_idf1}, of one aggregator {whole}"
    );
    assert!(
        alone_idf1 < whole - 4.0,
        "without neighbours no identity is handed over: {alone_idf1} of {whole}"
    );
    let [border, middle] =
        [&linked.cells.border, &linked.cells.middle].map(|part| part.at_best_f1.hota_pct.unwrap());
    assert!(
        border > middle - 3.0,
        "HOTA at borders {border}, in the middle {middle}"
    );
    let TownResult {
        hand_overs,
        received,
        refused,
        ..
    } = linked;
    assert!(hand_overs.begun > 20, "{hand_overs:?}");
    // The first second of each link, what comes twice, and what is overtaken.
    assert!(
        refused * 5 < received,
        "{refused} of {received} maps refused"
    );
}
