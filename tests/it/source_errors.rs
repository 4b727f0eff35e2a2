//! What cannot be opened, and what the error says of it.

use std::path::Path;

use crate::bags::{BagForm, BagWriter, tenth};
use crate::sources::params;
use splat_io::error::SourceError;
use splat_io::params::SourceParams;
use splat_mapper::node::open_source;

fn open_error(path: &Path, params: &SourceParams) -> SourceError {
    open_source::open(path.to_str().unwrap(), params, 0)
        .err()
        .unwrap_or_else(|| panic!("{} opened", path.display()))
}

#[test]
fn errors_on_opening_name_what_was_found_and_the_way_out() {
    let check = |path: &Path, params: &SourceParams, words: &[&str]| {
        let text = open_error(path, params).to_string();
        for word in words {
            assert!(text.contains(word), "{text:?} lacks {word:?}");
        }
        assert!(text.lines().count() == 1, "{text:?}");
    };
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    check(
        &root.join("absent"),
        &params(),
        &["no source URI", "absent"],
    );
    check(root, &params(), &["no .mcap file is in it"]);
    std::fs::create_dir(root.join("folder.mcap")).unwrap();
    check(root, &params(), &["not a regular file", "folder.mcap"]);
    std::fs::remove_dir(root.join("folder.mcap")).unwrap();
    std::fs::write(root.join("empty.mcap"), "").unwrap();
    check(
        &root.join("empty.mcap"),
        &params(),
        &["is empty", "ros2 bag record"],
    );
    std::fs::write(root.join("text.mcap"), "SQLite format 3").unwrap();
    check(
        &root.join("text.mcap"),
        &params(),
        &["begins with", "mcap convert"],
    );
    std::fs::write(root.join("magic.mcap"), mcap::MAGIC).unwrap();
    check(
        &root.join("magic.mcap"),
        &params(),
        &["no messages", "without an end record"],
    );
    let mut bag = BagWriter::new(BagForm::default());
    bag.add_payload("/cam", "foo_msgs/msg/Image", tenth(0), &[0, 1, 0, 0]);
    std::fs::write(root.join("wrong.mcap"), bag.finish()).unwrap();
    check(
        &root.join("wrong.mcap"),
        &params(),
        &["/cam (foo_msgs/msg/Image)", "--set source.image_topic"],
    );
    let named = |topic: &str| SourceParams {
        image_topic: topic.to_owned(),
        ..params()
    };
    check(
        &root.join("wrong.mcap"),
        &named("/cam"),
        &["\"/cam\" carries foo_msgs/msg/Image"],
    );
    check(&root.join("wrong.mcap"), &named("/other"), &["found /cam"]);
    for uri in ["ros2:/camera", "zenoh:key"] {
        check(
            Path::new(uri),
            &params(),
            &["not in this build", "ros2 bag record"],
        );
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_is_refused_and_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe.mcap");
    assert!(
        std::process::Command::new("mkfifo")
            .arg(&pipe)
            .status()
            .unwrap()
            .success()
    );
    assert!(
        open_error(folder.path(), &params())
            .to_string()
            .contains("not a regular file")
    );
    let list = format!(
        "0.0 {}\n0.1 ../../etc/hostname\n",
        pipe.file_name().unwrap().display()
    );
    let images = tempfile::tempdir().unwrap();
    std::fs::rename(&pipe, images.path().join("pipe.mcap")).unwrap();
    std::fs::write(images.path().join("images.txt"), list).unwrap();
    let uri = format!("images:{}", images.path().display());
    assert!(
        open_source::open(&uri, &params(), 0)
            .err()
            .unwrap()
            .to_string()
            .contains("none of the 1 images")
    );
}
