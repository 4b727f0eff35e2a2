//! The kernel's calls for video capture as safe functions. The one file of the crate with `unsafe` in it.
//!
//! Own stream and own calls over the bindings of `v4l`: its stream cannot go on after a timeout, and its conversions
//! panic on names that are not UTF-8.

use std::io;
use std::mem;
use std::os::raw::c_int;
use std::path::Path;
use std::ptr;
use std::slice;
use std::sync::Arc;
use std::time::Duration;

use v4l::v4l_sys as raw;
use v4l::v4l2::vidioc;

use crate::clock::Stamp;
use crate::source::camera::stamps::ClockReading;
use crate::source::v4l2::answers::{Caps, Control, Intervals, Sizes, Taken};

/// No driver has more formats, sizes or controls; one that has counts without end.
const MAX_LISTED: u32 = 512;
/// Makes the driver fill in what YUV numbers mean.
const PRIV_MAGIC: u32 = 0xfeed_cafe;
const CAPTURE: u32 = raw::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE;
const MMAP: u32 = raw::v4l2_memory_V4L2_MEMORY_MMAP;

/// An open device node.
#[derive(Debug)]
pub(super) struct Device {
    fd: c_int,
}

macro_rules! zeroed {
    ($kind:ty) => {{
        // SAFETY: a struct of numbers, arrays and unions of them as the kernel defines it; all zeros is a value.
        unsafe { mem::zeroed::<$kind>() }
    }};
}

impl Device {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        if path.as_os_str().as_encoded_bytes().contains(&0) {
            return Err(io::Error::from(io::ErrorKind::InvalidInput));
        }
        let flags = libc::O_RDWR | libc::O_NONBLOCK | libc::O_CLOEXEC;
        v4l::v4l2::open(path, flags).map(|fd| Self { fd })
    }

    /// One call to the driver, made again when a signal interrupts it.
    fn call<T>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        let stated_bytes = (request >> 16) as usize & 0x3fff;
        assert_eq!(stated_bytes, size_of::<T>(), "argument of another call");
        loop {
            let pointer = ptr::from_mut(argument).cast();
            // SAFETY: the kernel reads and writes as many bytes as the request states, which was compared with the
            // size of the argument, and any bytes are a value of these structs. Those used here hold no pointer that
            // these requests follow.
            match unsafe { v4l::v4l2::ioctl(self.fd, request, pointer) } {
                Err(e) if e.raw_os_error() == Some(libc::EINTR) => {}
                done => return done,
            }
        }
    }

    pub(super) fn caps(&self) -> io::Result<Caps> {
        let mut caps = zeroed!(raw::v4l2_capability);
        self.call(vidioc::VIDIOC_QUERYCAP, &mut caps)?;
        let has_own = caps.capabilities & raw::V4L2_CAP_DEVICE_CAPS != 0;
        Ok(Caps {
            driver: text(&caps.driver),
            card: text(&caps.card),
            bus: text(&caps.bus_info),
            flags: if has_own {
                caps.device_caps
            } else {
                caps.capabilities
            },
        })
    }

    /// Codes of the pixel formats, in the driver's order.
    pub(super) fn formats(&self) -> Vec<u32> {
        let ask = |index| {
            let mut format = zeroed!(raw::v4l2_fmtdesc);
            (format.index, format.type_) = (index, CAPTURE);
            self.call(vidioc::VIDIOC_ENUM_FMT, &mut format).ok()?;
            Some(format.pixelformat)
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(super) fn sizes(&self, fourcc: u32) -> Vec<Sizes> {
        let ask = |index| {
            let mut size = zeroed!(raw::v4l2_frmsizeenum);
            (size.index, size.pixel_format) = (index, fourcc);
            self.call(vidioc::VIDIOC_ENUM_FRAMESIZES, &mut size).ok()?;
            let sizes = size.__bindgen_anon_1;
            if size.type_ == raw::v4l2_frmsizetypes_V4L2_FRMSIZE_TYPE_DISCRETE {
                // SAFETY: both variants are plain numbers; the type says that this one was written.
                let one = unsafe { sizes.discrete };
                return Some(Sizes::Fixed {
                    width: one.width,
                    height: one.height,
                });
            }
            // SAFETY: both variants are plain numbers; the other types write this one.
            let s = unsafe { sizes.stepwise };
            Some(Sizes::Stepwise {
                width: [s.min_width, s.max_width, s.step_width.max(1)],
                height: [s.min_height, s.max_height, s.step_height.max(1)],
            })
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(super) fn intervals(&self, fourcc: u32, width: u32, height: u32) -> Vec<Intervals> {
        let ask = |index| {
            let mut interval = zeroed!(raw::v4l2_frmivalenum);
            (interval.index, interval.pixel_format) = (index, fourcc);
            (interval.width, interval.height) = (width, height);
            self.call(vidioc::VIDIOC_ENUM_FRAMEINTERVALS, &mut interval)
                .ok()?;
            let pair = |f: raw::v4l2_fract| (f.numerator, f.denominator);
            if interval.type_ == raw::v4l2_frmivaltypes_V4L2_FRMIVAL_TYPE_DISCRETE {
                // SAFETY: both variants are plain numbers; the type says that this one was written.
                return Some(Intervals::Fixed(pair(unsafe {
                    interval.__bindgen_anon_1.discrete
                })));
            }
            // SAFETY: both variants are plain numbers; the other types write this one.
            let steps = unsafe { interval.__bindgen_anon_1.stepwise };
            Some(Intervals::Between(pair(steps.min), pair(steps.max)))
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    /// Asks for a format. The driver may take another one, which comes back.
    pub(super) fn set_format(&self, fourcc: u32, width: u32, height: u32) -> io::Result<Taken> {
        let mut format = zeroed!(raw::v4l2_format);
        format.type_ = CAPTURE;
        let mut pix = zeroed!(raw::v4l2_pix_format);
        (pix.width, pix.height, pix.pixelformat) = (width, height, fourcc);
        (pix.field, pix.priv_) = (raw::v4l2_field_V4L2_FIELD_NONE, PRIV_MAGIC);
        format.fmt.pix = pix;
        self.call(vidioc::VIDIOC_S_FMT, &mut format)?;
        // SAFETY: plain numbers, written by the kernel for this type of buffer.
        let pix = unsafe { format.fmt.pix };
        // SAFETY: both variants are the same number.
        let ycbcr_enc = unsafe { pix.__bindgen_anon_1.ycbcr_enc };
        Ok(Taken {
            fourcc: pix.pixelformat,
            width: pix.width,
            height: pix.height,
            step: pix.bytesperline,
            field: pix.field,
            colorspace: pix.colorspace,
            ycbcr_enc,
            quantization: pix.quantization,
        })
    }

    /// Asks for seconds per picture; what the driver took comes back, `None` where it sets none.
    pub(super) fn set_interval(&self, (secs, pictures): (u32, u32)) -> io::Result<Option<f64>> {
        let mut parameters = zeroed!(raw::v4l2_streamparm);
        parameters.type_ = CAPTURE;
        let mut capture = zeroed!(raw::v4l2_captureparm);
        capture.timeperframe = raw::v4l2_fract {
            numerator: secs,
            denominator: pictures,
        };
        parameters.parm.capture = capture;
        self.call(vidioc::VIDIOC_S_PARM, &mut parameters)?;
        // SAFETY: plain numbers, written by the kernel for this type of buffer.
        let taken = unsafe { parameters.parm.capture }.timeperframe;
        let is_set = taken.numerator > 0 && taken.denominator > 0;
        Ok(is_set.then(|| f64::from(taken.denominator) / f64::from(taken.numerator)))
    }

    pub(super) fn controls(&self) -> Vec<Control> {
        let mut id = 0;
        let ask = |_| {
            let mut query = zeroed!(raw::v4l2_queryctrl);
            query.id = id | raw::V4L2_CTRL_FLAG_NEXT_CTRL;
            self.call(vidioc::VIDIOC_QUERYCTRL, &mut query).ok()?;
            id = query.id;
            Some(Control {
                id,
                name: text(&query.name),
                kind: query.type_,
                min: query.minimum,
                max: query.maximum,
                flags: query.flags,
            })
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(super) fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        let mut control = raw::v4l2_control { id, value };
        self.call(vidioc::VIDIOC_S_CTRL, &mut control)
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // A device that is gone may refuse; there is nothing left to close then.
        v4l::v4l2::close(self.fd).ok();
    }
}

/// A name as drivers write it: ends at the first zero, and need not be UTF-8.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).trim().to_owned()
}

/// Memory that the driver fills.
#[derive(Debug)]
struct Map {
    start: *mut libc::c_void,
    n_bytes: usize,
}

/// A filled buffer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Filled {
    index: u32,
    pub n_bytes: usize,
    pub flags: u32,
    pub sequence: u32,
    pub taken_nanos: i64,
}

/// A device that sends pictures, and the buffers that it fills.
#[derive(Debug)]
pub(super) struct Stream {
    device: Arc<Device>,
    maps: Vec<Map>,
}

// SAFETY: the maps belong to this struct alone, and their memory may be read from any thread.
unsafe impl Send for Stream {}

impl Stream {
    /// Maps the buffers, hands all of them to the driver and starts it. A fault undoes what was done.
    pub(super) fn start(device: &Arc<Device>, n_buffers: u32) -> io::Result<Self> {
        let mut request = zeroed!(raw::v4l2_requestbuffers);
        (request.count, request.type_, request.memory) = (n_buffers, CAPTURE, MMAP);
        device.call(vidioc::VIDIOC_REQBUFS, &mut request)?;
        let mut stream = Self {
            device: Arc::clone(device),
            maps: Vec::new(),
        };
        for index in 0..request.count {
            let map = stream.map(index)?;
            stream.maps.push(map);
        }
        for index in 0..request.count {
            stream.queue(index)?;
        }
        let mut kind = CAPTURE as c_int;
        device.call(vidioc::VIDIOC_STREAMON, &mut kind)?;
        Ok(stream)
    }

    fn map(&self, index: u32) -> io::Result<Map> {
        let mut buffer = buffer(index);
        self.device.call(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
        // SAFETY: plain numbers; for mapped memory the kernel writes the offset.
        let offset = unsafe { buffer.m.offset };
        let n_bytes = buffer.length as usize;
        let (access, shared) = (libc::PROT_READ, libc::MAP_SHARED);
        // SAFETY: a new mapping at an address of the kernel's choice; it is unmapped once, when the stream ends.
        let start = unsafe {
            v4l::v4l2::mmap(
                ptr::null_mut(),
                n_bytes,
                access,
                shared,
                self.device.fd,
                libc::off_t::from(offset),
            )
        }?;
        Ok(Map { start, n_bytes })
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        self.device.call(vidioc::VIDIOC_QBUF, &mut buffer(index))
    }

    /// Whether a buffer is filled, or a fault waits to be read, before the time is up.
    pub(super) fn wait(&self, wait: Duration) -> io::Result<bool> {
        let mut poll = libc::pollfd {
            fd: self.device.fd,
            events: libc::POLLIN,
            revents: 0,
        };
        let millis = c_int::try_from(wait.as_millis()).unwrap_or(c_int::MAX);
        // SAFETY: one struct, which lives until the call returns.
        match unsafe { libc::poll(&raw mut poll, 1, millis) } {
            n if n >= 0 => Ok(n > 0),
            _ => match io::Error::last_os_error() {
                e if e.raw_os_error() == Some(libc::EINTR) => Ok(false),
                e => Err(e),
            },
        }
    }

    /// The oldest filled buffer, which must be given back; `None` when there is none.
    pub(super) fn take(&mut self) -> io::Result<Option<Filled>> {
        let mut buffer = buffer(0);
        match self.device.call(vidioc::VIDIOC_DQBUF, &mut buffer) {
            Err(e) if e.raw_os_error() == Some(libc::EAGAIN) => return Ok(None),
            done => done?,
        }
        let time = buffer.timestamp;
        Ok(Some(Filled {
            index: buffer.index,
            n_bytes: buffer.bytesused as usize,
            flags: buffer.flags,
            sequence: buffer.sequence,
            taken_nanos: nanos(time.tv_sec, time.tv_usec.saturating_mul(1000)),
        }))
    }

    /// What a buffer holds until it is given back.
    pub(super) fn bytes(&self, filled: &Filled) -> &[u8] {
        let Some(map) = self.maps.get(filled.index as usize) else {
            return &[];
        };
        let n_bytes = filled.n_bytes.min(map.n_bytes);
        // SAFETY: the mapping lives as long as `self` and is at least this long; the driver does not write to a
        // buffer that it has handed out, and giving it back needs `&mut self`.
        unsafe { slice::from_raw_parts(map.start.cast::<u8>(), n_bytes) }
    }

    pub(super) fn give_back(&mut self, filled: Filled) -> io::Result<()> {
        self.queue(filled.index)
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A device that is gone refuses all of this, and has stopped anyway.
        let mut kind = CAPTURE as c_int;
        self.device.call(vidioc::VIDIOC_STREAMOFF, &mut kind).ok();
        for map in self.maps.drain(..) {
            // SAFETY: mapped by `map`, and unmapped only here.
            unsafe { v4l::v4l2::munmap(map.start, map.n_bytes) }.ok();
        }
        let mut request = zeroed!(raw::v4l2_requestbuffers);
        (request.type_, request.memory) = (CAPTURE, MMAP);
        self.device.call(vidioc::VIDIOC_REQBUFS, &mut request).ok();
    }
}

fn buffer(index: u32) -> raw::v4l2_buffer {
    let mut buffer = zeroed!(raw::v4l2_buffer);
    (buffer.index, buffer.type_, buffer.memory) = (index, CAPTURE, MMAP);
    buffer
}

/// The kernel's monotonic clock, which stamps pictures, before and after its wall clock.
pub(super) fn read_clocks() -> ClockReading {
    let read = |clock| {
        let mut time = zeroed!(libc::timespec);
        // SAFETY: one struct, which lives until the call returns; both clocks always exist.
        unsafe { libc::clock_gettime(clock, &raw mut time) };
        nanos(time.tv_sec, time.tv_nsec)
    };
    let before_nanos = read(libc::CLOCK_MONOTONIC);
    let wall = Stamp::from_nanos(read(libc::CLOCK_REALTIME));
    ClockReading {
        before_nanos,
        wall,
        after_nanos: read(libc::CLOCK_MONOTONIC),
    }
}

/// Drivers have been seen to send absurd times, so nothing here may overflow.
fn nanos(secs: impl Into<i64>, nanos: impl Into<i64>) -> i64 {
    let secs: i64 = secs.into();
    secs.saturating_mul(1_000_000_000)
        .saturating_add(nanos.into())
}
