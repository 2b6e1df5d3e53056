//! Programs that tests run.

use std::process::{Command, Stdio};

/// A program without input, and without the variables of the environment that configure a node.
pub fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    for (key, _) in std::env::vars_os() {
        if key.to_string_lossy().starts_with("ECOD_") {
            command.env_remove(key);
        }
    }
    command.stdin(Stdio::null());
    command
}

/// Runs a program that must succeed. The result is its standard output.
///
/// # Panics
/// Panics with the program's standard error if it cannot be run or fails.
pub fn output_of(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}
