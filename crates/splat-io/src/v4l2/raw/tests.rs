//! The structs against linux/videodev2.h, by a program in C.

use std::fmt::Write as _;
use std::mem::offset_of;
use std::process::Command;

use crate::v4l2::raw::*;

/// Expressions of C, and what they are by this file.
type Expected = Vec<(String, u64)>;

macro_rules! layout {
    ($to:ident, $ours:ident = $theirs:literal { $($field:ident = $name:literal),* $(,)? }) => {
        $to.push((concat!("sizeof(struct ", $theirs, ")").to_owned(), size_of::<$ours>() as u64));
        $($to.push((
            concat!("offsetof(struct ", $theirs, ", ", $name, ")").to_owned(),
            offset_of!($ours, $field) as u64,
        ));)*
    };
}

fn layouts() -> Expected {
    let mut all = Expected::new();
    layout!(all, Capability = "v4l2_capability" {
        driver = "driver", card = "card", bus_info = "bus_info", capabilities = "capabilities",
        device_caps = "device_caps",
    });
    layout!(all, FormatDescription = "v4l2_fmtdesc" {
        index = "index", kind = "type", pixelformat = "pixelformat",
    });
    layout!(all, FrameSize = "v4l2_frmsizeenum" {
        index = "index", pixel_format = "pixel_format", kind = "type", sizes = "discrete.width",
        sizes = "stepwise.min_width",
    });
    layout!(all, FrameInterval = "v4l2_frmivalenum" {
        index = "index", pixel_format = "pixel_format", width = "width", height = "height", kind = "type",
        intervals = "discrete.numerator", intervals = "stepwise.min",
    });
    layout!(all, Format = "v4l2_format" { kind = "type", body = "fmt.pix" });
    layout!(all, PixFormat = "v4l2_pix_format" {
        width = "width", height = "height", pixelformat = "pixelformat", field = "field",
        bytesperline = "bytesperline", colorspace = "colorspace", magic = "priv", ycbcr_enc = "ycbcr_enc",
        quantization = "quantization",
    });
    layout!(all, StreamParameters = "v4l2_streamparm" { kind = "type", capture = "parm.capture" });
    layout!(all, CaptureParameters = "v4l2_captureparm" { interval = "timeperframe" });
    layout!(all, Fraction = "v4l2_fract" { numerator = "numerator", denominator = "denominator" });
    layout!(all, QueryControl = "v4l2_queryctrl" {
        id = "id", kind = "type", name = "name", minimum = "minimum", maximum = "maximum", flags = "flags",
    });
    layout!(all, ControlValue = "v4l2_control" { id = "id", value = "value" });
    layout!(all, RequestBuffers = "v4l2_requestbuffers" { count = "count", kind = "type", memory = "memory" });
    layout!(all, Buffer = "v4l2_buffer" {
        index = "index", kind = "type", n_bytes_used = "bytesused", flags = "flags", stamp = "timestamp",
        sequence = "sequence", memory = "memory", place = "m.offset", n_bytes = "length",
    });
    layout!(all, TimeValue = "timeval" { secs = "tv_sec", micros = "tv_usec" });
    // Steps inside of the arrays that stand for structs.
    let step = size_of::<u32>() as u64;
    for (place, name) in [
        "max_width",
        "step_width",
        "min_height",
        "max_height",
        "step_height",
    ]
    .iter()
    .enumerate()
    {
        let expression = format!("offsetof(struct v4l2_frmsize_stepwise, {name})");
        all.push((expression, (place as u64 + 1) * step));
    }
    all.push((
        "offsetof(struct v4l2_frmsize_discrete, height)".to_owned(),
        step,
    ));
    all.push((
        "offsetof(struct v4l2_frmival_stepwise, max)".to_owned(),
        2 * step,
    ));
    all
}

fn numbers() -> Expected {
    macro_rules! call {
        ($ours:expr, $theirs:literal) => {
            // C has these as 32 bits without a sign; musl takes them as int.
            ($theirs.to_owned(), u64::from($ours.number() as u32))
        };
    }
    let constant = |name: &str, ours: u32| (name.to_owned(), u64::from(ours));
    vec![
        call!(QUERYCAP, "VIDIOC_QUERYCAP"),
        call!(ENUM_FMT, "VIDIOC_ENUM_FMT"),
        call!(S_FMT, "VIDIOC_S_FMT"),
        call!(REQBUFS, "VIDIOC_REQBUFS"),
        call!(QUERYBUF, "VIDIOC_QUERYBUF"),
        call!(QBUF, "VIDIOC_QBUF"),
        call!(DQBUF, "VIDIOC_DQBUF"),
        call!(STREAMON, "VIDIOC_STREAMON"),
        call!(STREAMOFF, "VIDIOC_STREAMOFF"),
        call!(S_PARM, "VIDIOC_S_PARM"),
        call!(S_CTRL, "VIDIOC_S_CTRL"),
        call!(QUERYCTRL, "VIDIOC_QUERYCTRL"),
        call!(ENUM_FRAMESIZES, "VIDIOC_ENUM_FRAMESIZES"),
        call!(ENUM_FRAMEINTERVALS, "VIDIOC_ENUM_FRAMEINTERVALS"),
        constant("V4L2_BUF_TYPE_VIDEO_CAPTURE", BUFFER_TYPE_VIDEO_CAPTURE),
        constant("V4L2_MEMORY_MMAP", MEMORY_MMAP),
        constant("V4L2_FIELD_NONE", FIELD_NONE),
        constant("V4L2_FRMSIZE_TYPE_DISCRETE", SIZE_IS_DISCRETE),
        constant("V4L2_FRMIVAL_TYPE_DISCRETE", INTERVAL_IS_DISCRETE),
        constant("V4L2_CAP_DEVICE_CAPS", HAS_DEVICE_CAPS),
        constant("V4L2_PIX_FMT_PRIV_MAGIC", PIX_FORMAT_MAGIC),
        constant("V4L2_CTRL_FLAG_NEXT_CTRL", NEXT_CONTROL),
    ]
}

#[test]
fn structs_and_numbers_are_those_of_the_kernels_header() {
    let expected = [layouts(), numbers()].concat();
    let folder = tempfile::tempdir().unwrap();
    let (source, program) = (folder.path().join("v4l2.c"), folder.path().join("v4l2"));
    let mut text =
        "#include <linux/videodev2.h>\n#include <stddef.h>\n#include <stdio.h>\n".to_owned();
    text += "#include <sys/time.h>\nint main(void) {\n";
    for (expression, _) in &expected {
        writeln!(
            text,
            "printf(\"%llu\\n\", (unsigned long long)(unsigned)({expression}));"
        )
        .unwrap();
    }
    std::fs::write(&source, text + "return 0;\n}\n").unwrap();
    let compiler = Command::new("cc")
        .arg(&source)
        .arg("-o")
        .arg(&program)
        .status();
    assert!(
        compiler.expect("a C compiler").success(),
        "needs linux/videodev2.h"
    );
    let output = Command::new(&program).output().unwrap();
    let found = String::from_utf8(output.stdout).unwrap();
    let found: Vec<u64> = found.lines().map(|line| line.parse().unwrap()).collect();
    assert_eq!(found.len(), expected.len());
    for ((expression, ours), theirs) in expected.iter().zip(found) {
        assert_eq!(*ours, theirs, "{expression}");
    }
}
