//! The help of programs.

use crate::program::{command, output_of};

/// The output of `--help` of a program and of all its commands, each after its command line.
///
/// # Panics
/// Panics if the program or one of its commands has no help.
pub fn help_of(program: &str) -> String {
    let mut text = String::new();
    let mut commands = vec![Vec::new()];
    while let Some(path) = commands.pop() {
        let help = help(program, &path);
        let name = program.rsplit('/').next().unwrap_or(program);
        let called = [&[name.to_owned()], path.as_slice()].concat().join(" ");
        text += &format!("$ {called} --help\n{help}\n");
        // The last is popped first.
        for below in names(&help).into_iter().rev() {
            commands.push([path.as_slice(), &[below]].concat());
        }
    }
    text
}

/// The help of one command, without spaces at the end of lines.
fn help(program: &str, path: &[String]) -> String {
    output_of(command(program).args(path).arg("--help"))
        .lines()
        .map(|line| line.trim_end().to_owned() + "\n")
        .collect()
}

/// The commands that a help lists.
fn names(help: &str) -> Vec<String> {
    help.lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.is_empty())
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}
