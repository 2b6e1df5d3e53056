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
const BYTE_ORDER_MARK: char = '\u{feff}';

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

/// Reads a regular file as UTF-8 text, without a byte order mark.
///
/// # Errors
/// Returns the errors of [`read`], or [`io::ErrorKind::InvalidData`] if the content is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    let bytes = read(path, MAX_TEXT_BYTES)?;
    let text = String::from_utf8(bytes).map_err(|error| {
        let place = error.utf8_error().valid_up_to();
        io::Error::new(
            io::ErrorKind::InvalidData,
            format!("it is no text in UTF-8, from byte {place} on"),
        )
    })?;
    Ok(text
        .strip_prefix(BYTE_ORDER_MARK)
        .map(str::to_owned)
        .unwrap_or(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pipes_devices_and_directories_are_refused_at_once() {
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
    fn a_file_is_read_up_to_its_bound_and_text_without_a_byte_order_mark() {
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
        assert!(error.contains("from byte 4 on"), "{error}");
    }
}
