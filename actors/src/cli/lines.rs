//! Files of lines, read in bounded memory; `-` stands for standard input and output.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, BufWriter, IsTerminal, Read, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::platform::bounded_file::BYTE_ORDER_MARK;

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
/// Returns an error if the source cannot be read.
pub fn read_line(
    source: &mut impl BufRead,
    limit: usize,
    line: &mut Vec<u8>,
) -> io::Result<LineRead> {
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

/// Byte order marks of UTF-16. UTF-16 text has no single-byte line end.
const WIDE_MARKS: [&[u8]; 2] = [b"\xff\xfe", b"\xfe\xff"];

/// Opens a file to read, after a byte order mark.
///
/// # Errors
/// Returns an error that names the file.
pub fn open(path: &Path) -> anyhow::Result<Box<dyn BufRead>> {
    if path == Path::new("-") {
        return Ok(Box::new(io::stdin().lock()));
    }
    let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    let kind = file
        .metadata()
        .with_context(|| format!("cannot read {}", path.display()))?
        .file_type();
    if kind.is_dir() {
        bail!("cannot read {}: it is a directory", path.display());
    }
    // A pipe ends with its writer; a device may not end.
    if kind.is_block_device() || kind.is_char_device() && !file.is_terminal() {
        bail!("cannot read {}: it is a device, not a file", path.display());
    }
    let mut source = BufReader::with_capacity(1 << 18, file);
    let begin = source
        .fill_buf()
        .with_context(|| format!("cannot read {}", path.display()))?;
    if WIDE_MARKS.iter().any(|mark| begin.starts_with(mark)) {
        bail!(
            "cannot read {}: it is text in UTF-16, save it as UTF-8",
            path.display()
        );
    }
    if begin.starts_with(BYTE_ORDER_MARK) {
        source.consume(BYTE_ORDER_MARK.len());
    }
    Ok(Box::new(source))
}

/// Checks that an output file differs from all `inputs`.
///
/// # Errors
/// Returns an error that names the file.
pub fn check_apart<P: AsRef<Path>>(path: &Path, inputs: &[P]) -> anyhow::Result<()> {
    // A file may have several names.
    let file = |path: &Path| {
        fs::metadata(path)
            .ok()
            .map(|metadata| (metadata.dev(), metadata.ino()))
    };
    let ours = file(path);
    if ours.is_some() && inputs.iter().any(|input| file(input.as_ref()) == ours) {
        bail!(
            "{} is both input and output; choose another output file",
            path.display()
        );
    }
    Ok(())
}

/// Creates or truncates a file that differs from all `inputs`.
///
/// # Errors
/// Returns an error that names the file.
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
    fn input_alias_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let [read, linked, hard] = ["read", "linked", "hard"].map(|name| folder.path().join(name));
        fs::write(&read, "\u{feff}first\n").unwrap();
        std::os::unix::fs::symlink(&read, &linked).unwrap();
        fs::hard_link(&read, &hard).unwrap();
        for name in [&read, &linked, &hard] {
            let error = create(name, std::slice::from_ref(&read))
                .err()
                .unwrap()
                .to_string();
            assert!(
                error.ends_with("is both input and output; choose another output file"),
                "{error}"
            );
        }
        let mut line = String::new();
        open(&read).unwrap().read_line(&mut line).unwrap();
        assert_eq!(line, "first\n");
    }

    #[test]
    fn unreadable_file_is_named() {
        // Address 0 of a process is not readable.
        let error = open(Path::new("/proc/self/mem")).err().unwrap();
        assert_eq!(error.to_string(), "cannot read /proc/self/mem");
    }

    #[test]
    fn overlong_line_is_skipped() {
        let mut source = BufReader::with_capacity(3, &b"12345\n123456\n\n12345678901\nlast"[..]);
        let mut line = Vec::new();
        let mut next = || {
            let read = read_line(&mut source, 5, &mut line).unwrap();
            (
                read,
                if read == LineRead::Whole {
                    String::from_utf8(line.clone()).unwrap()
                } else {
                    String::new()
                },
            )
        };
        use LineRead::{End, TooLarge, Whole};
        for (read, text) in [
            (Whole, "12345"),
            (TooLarge, ""),
            (Whole, ""),
            (TooLarge, ""),
            (Whole, "last"),
            (End, ""),
        ] {
            assert_eq!(next(), (read, text.to_owned()));
        }
    }
}
