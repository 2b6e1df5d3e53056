//! Reading files given by users: only regular files, up to a size. Reading a pipe or a device might
//! not end.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;

/// Maximum size of a text file in bytes: configurations, keys, certificates, labels, recorded
/// detections.
const MAX_TEXT_BYTES: u64 = 256 * 1024 * 1024;

/// Some editors begin a text with it.
pub const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();

/// Opens a regular file for reading. Opening does not block, as it would for a pipe without a
/// writer.
///
/// # Errors
/// Returns the operating system's error, or [`io::ErrorKind::InvalidInput`] if the file is not
/// regular.
pub fn open(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(OFlags::NONBLOCK.bits() as i32)
        .open(path)?;
    let metadata = file.metadata()?;
    if metadata.is_dir() {
        return Err(io::Error::new(
            io::ErrorKind::IsADirectory,
            "it is a directory",
        ));
    }
    if !metadata.is_file() {
        let reason = "it is a pipe, socket or device, not a regular file";
        return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
    }
    Ok(file)
}

/// Reads a regular file of at most `max_bytes`.
///
/// # Errors
/// Returns the errors of [`open`], or [`io::ErrorKind::FileTooLarge`].
pub fn read(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(max_bytes + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > max_bytes {
        return Err(io::Error::new(
            io::ErrorKind::FileTooLarge,
            format!("it has more than {max_bytes} bytes"),
        ));
    }
    Ok(bytes)
}

/// Reads a regular file as text, without a byte order mark and with line feeds as line ends. The
/// text is in UTF-8, or in UTF-16 with a byte order mark.
///
/// # Errors
/// Returns the errors of [`read`], or [`io::ErrorKind::InvalidData`] with the first line that is no
/// such text.
pub fn read_text(path: &Path) -> io::Result<String> {
    let bytes = without_mark(read(path, MAX_TEXT_BYTES)?)?;
    let text = String::from_utf8(bytes).map_err(|error| {
        let place = error.utf8_error().valid_up_to();
        let before = String::from_utf8_lossy(error.as_bytes().get(..place).unwrap_or_default());
        let line = 1 + unix_lines(&before).matches('\n').count();
        invalid(format!(
            "it is no text in UTF-8, from line {line} (byte {place}) on: save it as UTF-8"
        ))
    })?;
    if text.contains('\r') {
        return Ok(unix_lines(&text));
    }
    Ok(text)
}

/// A text with the line ends of Unix.
fn unix_lines(text: &str) -> String {
    text.replace("\r\n", "\n").replace('\r', "\n")
}

/// The bytes of a text without a byte order mark, in UTF-8 if the mark is of UTF-16. Other bytes
/// stay, for formats that allow any between their own.
///
/// # Errors
/// Returns [`io::ErrorKind::InvalidData`] if the mark is of UTF-16, but the text is not.
pub fn without_mark(mut bytes: Vec<u8>) -> io::Result<Vec<u8>> {
    match bytes.as_slice() {
        [0xff, 0xfe, text @ ..] => from_utf16(text, u16::from_le_bytes),
        [0xfe, 0xff, text @ ..] => from_utf16(text, u16::from_be_bytes),
        _ => {
            if bytes.starts_with(BYTE_ORDER_MARK) {
                bytes.drain(..BYTE_ORDER_MARK.len());
            }
            Ok(bytes)
        }
    }
}

/// A text in UTF-16 as UTF-8; `unit` reads two bytes in the text's order.
fn from_utf16(text: &[u8], unit: fn([u8; 2]) -> u16) -> io::Result<Vec<u8>> {
    let (pairs, rest) = text.as_chunks::<2>();
    let units: Vec<u16> = pairs.iter().copied().map(unit).collect();
    match String::from_utf16(&units) {
        Ok(text) if rest.is_empty() => Ok(text.into_bytes()),
        _ => Err(invalid(
            "it begins as text in UTF-16, but is none: save it as UTF-8".into(),
        )),
    }
}

fn invalid(fault: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, fault)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pipes_and_directories_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR,
            0,
        )
        .unwrap();
        for path in [pipe.as_path(), Path::new("/dev/zero")] {
            let error = read_text(path).unwrap_err();
            assert_eq!(
                error.kind(),
                io::ErrorKind::InvalidInput,
                "{}",
                path.display()
            );
            assert!(error.to_string().contains("not a regular file"), "{error}");
        }
        assert_eq!(
            read_text(folder.path()).unwrap_err().kind(),
            io::ErrorKind::IsADirectory
        );
        assert_eq!(
            read_text(&folder.path().join("missing"))
                .unwrap_err()
                .kind(),
            io::ErrorKind::NotFound
        );
    }

    #[test]
    fn read_is_bounded_without_bom() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("labels.txt");
        std::fs::write(&path, "\u{feff}car\nperson\n").unwrap();
        assert_eq!(read_text(&path).unwrap(), "car\nperson\n");
        assert_eq!(read(&path, 14).unwrap().len(), 14);
        assert_eq!(
            read(&path, 13).unwrap_err().kind(),
            io::ErrorKind::FileTooLarge
        );
        std::fs::write(&path, b"car\n\xff").unwrap();
        let error = read_text(&path).unwrap_err().to_string();
        assert!(error.contains("from line 2 (byte 4) on"), "{error}");
    }

    #[test]
    fn encodings_give_equal_text() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("labels.txt");
        let text = "car\nF\u{fc}\u{df}e \u{1f697}\n\nlast";
        for ends in ["\n", "\r\n", "\r"] {
            let text = text.replace('\n', ends);
            let marked = format!("\u{feff}{text}");
            let units = |of: fn(u16) -> [u8; 2]| marked.encode_utf16().flat_map(of).collect();
            let encoded: [Vec<u8>; 4] = [
                text.clone().into(),
                marked.clone().into(),
                units(u16::to_le_bytes),
                units(u16::to_be_bytes),
            ];
            for bytes in encoded {
                std::fs::write(&path, &bytes).unwrap();
                assert_eq!(
                    read_text(&path).unwrap().lines().collect::<Vec<_>>(),
                    ["car", "F\u{fc}\u{df}e \u{1f697}", "", "last"],
                    "{bytes:?}"
                );
            }
        }
        for half in [&b"\xff\xfea"[..], b"\xff\xfe\x00\xd8"] {
            std::fs::write(&path, half).unwrap();
            let error = read_text(&path).unwrap_err().to_string();
            assert!(error.contains("save it as UTF-8"), "{error}");
        }
    }
}
