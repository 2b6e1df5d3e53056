//! Files of lines, read in bounded memory; `-` stands for standard input and output.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// Result of reading a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineRead {
    /// The whole line, without its end.
    Whole,
    /// More than the limit; the rest was skipped.
    TooLarge,
    /// The end of the file.
    End,
}

/// Reads the next line into `line`, of at most `limit` bytes.
///
/// # Errors
/// When the source cannot be read.
pub fn read_line(source: &mut impl BufRead, limit: usize, line: &mut Vec<u8>) -> io::Result<LineRead> {
    line.clear();
    let bound = u64::try_from(limit).unwrap_or(u64::MAX).saturating_add(1);
    if source.by_ref().take(bound).read_until(b'\n', line)? == 0 {
        return Ok(LineRead::End);
    }
    if line.last() == Some(&b'\n') {
        line.pop();
    } else if line.len() > limit {
        source.skip_until(b'\n')?;
        return Ok(LineRead::TooLarge);
    }
    Ok(LineRead::Whole)
}

/// Opens a file to read.
///
/// # Errors
/// Naming the file.
pub fn open(path: &Path) -> anyhow::Result<Box<dyn BufRead>> {
    if path == Path::new("-") {
        return Ok(Box::new(io::stdin().lock()));
    }
    let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    if file.metadata().is_ok_and(|metadata| metadata.is_dir()) {
        bail!("cannot read {}: it is a directory", path.display());
    }
    Ok(Box::new(BufReader::with_capacity(1 << 18, file)))
}

/// Checks that an output file is none of `inputs`.
///
/// # Errors
/// Naming the file.
pub fn check_apart<P: AsRef<Path>>(path: &Path, inputs: &[P]) -> anyhow::Result<()> {
    let ours = fs::canonicalize(path).ok();
    if ours.is_some() && inputs.iter().any(|input| fs::canonicalize(input).ok() == ours) {
        bail!("{} is to be both read and written", path.display());
    }
    Ok(())
}

/// Creates or truncates a file that is none of `inputs`.
///
/// # Errors
/// Naming the file.
pub fn create(path: &Path, inputs: &[PathBuf]) -> anyhow::Result<Box<dyn Write>> {
    if path == Path::new("-") {
        return Ok(Box::new(BufWriter::new(io::stdout().lock())));
    }
    check_apart(path, inputs)?;
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Box::new(BufWriter::with_capacity(1 << 18, file)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_bounded_and_the_rest_of_a_large_one_is_passed_over() {
        let mut source = BufReader::with_capacity(3, &b"12345\n123456\n\n12345678901\nlast"[..]);
        let mut line = Vec::new();
        let mut next = || {
            let read = read_line(&mut source, 5, &mut line).unwrap();
            (read, if read == LineRead::Whole { String::from_utf8(line.clone()).unwrap() } else { String::new() })
        };
        use LineRead::{End, TooLarge, Whole};
        for (read, text) in [(Whole, "12345"), (TooLarge, ""), (Whole, ""), (TooLarge, ""), (Whole, "last"), (End, "")]
        {
            assert_eq!(next(), (read, text.to_owned()));
        }
    }
}
