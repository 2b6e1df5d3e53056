//! The errors of programs, as snapshots show them.

use std::fmt::Write;
use std::path::Path;

use crate::program::command;

/// The errors of a program for command lines that it must refuse, whose arguments are separated by blanks. Each command
/// runs in a directory of its own, in which `prepare` creates files.
///
/// # Panics
/// Panics if the program cannot be run or carries out a command.
pub fn errors_of(program: &str, commands: &[&str], prepare: impl Fn(&Path)) -> String {
    let name = program.rsplit('/').next().unwrap_or(program);
    let mut shown = String::new();
    for arguments in commands {
        let directory = tempfile::tempdir().unwrap();
        prepare(directory.path());
        let output = command(program)
            .args(arguments.split_whitespace())
            .current_dir(directory.path())
            .output()
            .unwrap();
        assert!(!output.status.success(), "{arguments} is carried out");
        let error = String::from_utf8(output.stderr).unwrap();
        shown += &error_case(&format!("{name} {arguments}"), &error);
    }
    shown
}

/// An input that cannot be used, each line behind a bar, and the error about it.
pub fn error_case(input: &str, error: &str) -> String {
    let mut shown = String::new();
    for line in input.lines() {
        writeln!(shown, "| {line}").unwrap();
    }
    writeln!(shown, "{}\n", error.trim_end()).unwrap();
    shown
}
