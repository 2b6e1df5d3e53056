//! The program that the README shows to developers, run as it is.

use std::path::Path;
use std::process::Command;

#[test]
fn three_reports_are_one_map() {
    // It is built with the tests.
    let tests = std::env::current_exe().unwrap();
    let program = tests
        .parent()
        .and_then(Path::parent)
        .unwrap()
        .join("examples/three_reports");
    let output = Command::new(program).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}");
    let last = &said[said.rfind("round ").expect("rounds")..];
    let places: Vec<_> = last.lines().skip(1).map(str::trim).collect();
    let [first, second, third] = places[..] else {
        panic!("{last}")
    };
    assert!(
        first.starts_with("slot-0: ABC123 ")
            && first.contains("euclid")
            && first.contains("galileo"),
        "{first}"
    );
    assert!(
        second.starts_with("slot-1: XYZ789 ") && second.contains("riemann"),
        "{second}"
    );
    assert!(third.starts_with("slot-2: empty "), "{third}");
}
