use std::path::Path;
use std::time::Duration;

use opencv::core::Vec3b;
use opencv::prelude::*;

use super::*;

fn brightness(frame: &CameraFrame) -> u8 {
    frame.image.at_2d::<Vec3b>(24, 32).unwrap()[1]
}

fn open(toml: &str) -> Result<Box<dyn FrameSource>, FrameError> {
    toml::from_str::<SourceConfig>(toml)
        .unwrap()
        .open(Duration::from_secs(5))
}

/// Brightness of all frames up to the error that ends them.
fn play(source: &mut dyn FrameSource) -> (Vec<u8>, FrameError) {
    let mut seen = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => seen.push(brightness(&frame)),
            Err(error) => return (seen, error),
        }
    }
}

fn write_images(directory: &Path) {
    for (number, value) in [50, 100, 150].into_iter().enumerate() {
        let file = directory.join(format!("f{number:03}.png"));
        image::save_buffer(
            file,
            &[value; 64 * 48],
            64,
            48,
            image::ExtendedColorType::L8,
        )
        .unwrap();
    }
    std::fs::write(directory.join("notes.txt"), "not an image").unwrap();
}

#[test]
fn directory_and_pattern_keep_order() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    for path in [
        directory.path().to_owned(),
        directory.path().join("f%03d.png"),
    ] {
        let mut source = open(&format!("kind = 'images'\npath = {path:?}\nfps = 500.0")).unwrap();
        let (seen, end) = play(source.as_mut());
        assert_eq!(seen, [50, 100, 150], "{path:?}");
        assert_eq!(
            end,
            FrameError::Ended {
                origin: path.display().to_string()
            }
        );

        let mut source = open(&format!(
            "kind = 'images'\npath = {path:?}\nfps = 500.0\nlooping = true"
        ))
        .unwrap();
        let seen: Vec<u8> = (0..5)
            .map(|_| brightness(&source.next_frame().unwrap()))
            .collect();
        assert_eq!(seen, [50, 100, 150, 50, 100]);
    }
}

#[test]
fn percent_sign_is_pattern_before_number() {
    let parent = tempfile::tempdir().unwrap();
    for (folder, pattern) in [
        ("run_50%", ""),
        ("day%03d", ""),
        ("a:b 100%d", "f%03d.png"),
        ("-", "f%03d.png"),
    ] {
        let directory = parent.path().join(folder);
        std::fs::create_dir(&directory).unwrap();
        write_images(&directory);
        let path = directory.join(pattern);
        let mut source = open(&format!("kind = 'images'\npath = {path:?}\nfps = 500.0")).unwrap();
        assert_eq!(play(source.as_mut()).0, [50, 100, 150], "{path:?}");
    }
    let marked = parent.path().join("50%_f000.png");
    std::fs::copy(parent.path().join("-/f000.png"), marked).unwrap();
    let path = parent.path().join("50%_f%03d.png");
    let mut source = open(&format!("kind = 'images'\npath = {path:?}\nfps = 500.0")).unwrap();
    assert_eq!(play(source.as_mut()).0, [50]);
}

#[test]
fn bad_image_is_skipped() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    std::fs::write(directory.path().join("f001.png"), "half a fi").unwrap();
    let mut source = open(&format!(
        "kind = 'images'\npath = {:?}\nfps = 500.0",
        directory.path()
    ))
    .unwrap();
    let mut played = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => played.push(brightness(&frame).to_string()),
            Err(FrameError::Ended { .. }) => break,
            Err(error) => played.push(error.to_string()),
        }
    }
    assert_eq!((&*played[0], &*played[2], played.len()), ("50", "150", 3));
    assert!(
        played[1].contains("f001.png") && played[1].contains("not an image"),
        "{}",
        played[1]
    );
}

#[test]
fn images_keep_their_rate() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    let mut source = open(&format!(
        "kind = 'images'\npath = {:?}\nfps = 20.0",
        directory.path()
    ))
    .unwrap();
    let started = Instant::now();
    play(source.as_mut());
    assert!(
        started.elapsed() >= Duration::from_millis(100),
        "three frames are two periods of 50 ms apart"
    );
}

#[test]
fn unopenable_source_names_reason() {
    let empty = tempfile::tempdir().unwrap();
    let text = empty.path().join("camera");
    std::fs::write(&text, "not a camera").unwrap();
    for (config, name, reason) in [
        (
            "kind = 'v4l2'\ndevice = '/dev/video-none'".into(),
            "/dev/video-none",
            "No such file",
        ),
        (
            "kind = 'images'\npath = 'no/such/directory'".into(),
            "no/such/directory",
            "No such file",
        ),
        (
            "kind = 'images'\npath = 'frames/%s.png'".into(),
            "frames/%s.png",
            "%d",
        ),
        (
            format!("kind = 'images'\npath = {:?}", empty.path()),
            "",
            "no images",
        ),
        (
            format!("kind = 'v4l2'\ndevice = {text:?}"),
            "camera",
            "it is no camera",
        ),
    ] {
        let error = open(&config).err().expect("cannot be opened").to_string();
        assert!(
            error.starts_with("cannot open ") && error.contains(name) && error.contains(reason),
            "{error}"
        );
    }
}

#[test]
fn bad_configuration_is_refused() {
    assert!(
        toml::from_str::<SourceConfig>("kind = 'video'\npath = 'a'\nspeed = 2").is_err(),
        "unknown key"
    );
    let pipeline: SourceConfig =
        toml::from_str("kind = 'gstreamer'\npipeline = 'videotestsrc'").unwrap();
    assert_eq!(pipeline.validate().expect_err("no appsink").key, "pipeline");
    let camera: SourceConfig = toml::from_str("kind = 'v4l2'\nwidth = 0").unwrap();
    assert_eq!(camera.validate().expect_err("no width").key, "width");
    let images: SourceConfig = toml::from_str("kind = 'images'\npath = 'a'\nfps = 0.0").unwrap();
    assert_eq!(images.validate().expect_err("no rate").key, "fps");
    for source in [
        "kind = 'v4l2'",
        "kind = 'gstreamer'\npipeline = 'videotestsrc ! appsink'",
        "kind = 'url'\nurl = 'rtsp://camera/1'",
    ] {
        let with = |latency_s: &str| {
            let text = format!("{source}\nlatency_s = {latency_s}");
            toml::from_str::<SourceConfig>(&text).unwrap().validate()
        };
        assert_eq!(with("0.35"), Ok(()));
        for latency_s in ["-0.1", "10.5", "nan"] {
            assert_eq!(with(latency_s).expect_err(latency_s).key, "latency_s");
        }
    }
    assert!(
        toml::from_str::<SourceConfig>("kind = 'video'\npath = 'a'\nlatency_s = 0.1").is_err(),
        "a recording has none"
    );
}

#[test]
fn source_texts_hide_password() {
    for password in [
        "Geh/eim1",
        "Geh eim1",
        "Geh\"eim1",
        "Geh'eim1",
        "G@h/eim1",
        "Geh?eim1",
        "Geh#eim1",
        "eim1",
    ] {
        let url = format!("rtsp://admin:{password}@127.0.0.1:1/stream1");
        let mut source = SourceConfig::Url {
            url: url.clone(),
            latency_s: None,
        };
        let said = [
            source.origin(),
            source.redacted(&format!("cannot open {url}: refused")),
            source.redacted(&format!("[tcp] admin:{password}@127.0.0.1 is refused")),
            source.redacted(&format!("wrong password \"{password}\"")),
            source
                .validate()
                .err()
                .map(|error| error.to_string())
                .unwrap_or_default(),
        ];
        for text in said {
            assert!(!text.contains("eim1") && !text.contains("Geh"), "{text}");
        }
        assert_eq!(source.remove_credentials(), Some("url"));
        assert!(!format!("{source:?}").contains("eim1"), "{source:?}");

        let quote = if password.contains('"') { '\'' } else { '"' };
        let mut pipeline = SourceConfig::Gstreamer {
            pipeline: format!("rtspsrc location={quote}{url}{quote} ! fakesink"),
            latency_s: None,
        };
        let error = pipeline.validate().expect_err("no appsink").to_string();
        assert!(!error.contains("eim1") && !error.contains("Geh"), "{error}");
        assert_eq!(pipeline.remove_credentials(), Some("pipeline"));
        assert!(!format!("{pipeline:?}").contains("eim1"), "{pipeline:?}");
    }
}
