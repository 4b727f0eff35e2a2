//! The kernel's calls for video capture as safe functions. The one file of the crate with `unsafe` in it.
//!
//! Structs and numbers of the calls are those of `raw`.

use std::ffi::CString;
use std::os::raw::c_int;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use std::{io, ptr, slice};

use bytemuck::Zeroable;

use crate::camera::stamps::ClockReading;
use crate::v4l2::answers::{Caps, Control, Intervals, Sizes, Taken};
use crate::v4l2::raw::{self, Call};
use splat_types::time::Stamp;

/// No driver has more formats, sizes or controls; one that has counts without end.
const MAX_LISTED: u32 = 512;
const CAPTURE: u32 = raw::BUFFER_TYPE_VIDEO_CAPTURE;
const MMAP: u32 = raw::MEMORY_MMAP;

/// An open device node.
#[derive(Debug)]
pub(crate) struct Device {
    fd: c_int,
}

impl Device {
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let path = CString::new(path.as_os_str().as_encoded_bytes())?;
        let flags = libc::O_RDWR | libc::O_NONBLOCK | libc::O_CLOEXEC;
        // SAFETY: a string that ends in zero and lives until the call returns.
        match unsafe { libc::open(path.as_ptr(), flags) } {
            -1 => Err(io::Error::last_os_error()),
            fd => Ok(Self { fd }),
        }
    }

    /// One call to the driver, made again when a signal interrupts it.
    fn call<T>(&self, call: &Call<T>, argument: &mut T) -> io::Result<()> {
        loop {
            // SAFETY: the kernel reads and writes as many bytes as the number of the call states, which is the size of
            // the argument by the making of `Call`, and any bytes are a value of these structs. They hold no pointer
            // that these calls follow.
            if unsafe { libc::ioctl(self.fd, call.number(), ptr::from_mut(argument)) } != -1 {
                return Ok(());
            }
            let error = io::Error::last_os_error();
            if error.raw_os_error() != Some(libc::EINTR) {
                return Err(error);
            }
        }
    }

    pub(crate) fn caps(&self) -> io::Result<Caps> {
        let mut caps = raw::Capability::zeroed();
        self.call(&raw::QUERYCAP, &mut caps)?;
        let has_own = caps.capabilities & raw::HAS_DEVICE_CAPS != 0;
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
    pub(crate) fn formats(&self) -> Vec<u32> {
        let ask = |index| {
            let mut format = raw::FormatDescription::zeroed();
            (format.index, format.kind) = (index, CAPTURE);
            self.call(&raw::ENUM_FMT, &mut format).ok()?;
            Some(format.pixelformat)
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(crate) fn sizes(&self, fourcc: u32) -> Vec<Sizes> {
        let ask = |index| {
            let mut size = raw::FrameSize::zeroed();
            (size.index, size.pixel_format) = (index, fourcc);
            self.call(&raw::ENUM_FRAMESIZES, &mut size).ok()?;
            let [width, height, ..] = size.sizes;
            if size.kind == raw::SIZE_IS_DISCRETE {
                return Some(Sizes::Fixed { width, height });
            }
            let [
                min_width,
                max_width,
                step_width,
                min_height,
                max_height,
                step_height,
            ] = size.sizes;
            Some(Sizes::Stepwise {
                width: [min_width, max_width, step_width.max(1)],
                height: [min_height, max_height, step_height.max(1)],
            })
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(crate) fn intervals(&self, fourcc: u32, width: u32, height: u32) -> Vec<Intervals> {
        let ask = |index| {
            let mut interval = raw::FrameInterval::zeroed();
            (interval.index, interval.pixel_format) = (index, fourcc);
            (interval.width, interval.height) = (width, height);
            self.call(&raw::ENUM_FRAMEINTERVALS, &mut interval).ok()?;
            let pair = |f: raw::Fraction| (f.numerator, f.denominator);
            let [first, second, _] = interval.intervals.map(pair);
            Some(if interval.kind == raw::INTERVAL_IS_DISCRETE {
                Intervals::Fixed(first)
            } else {
                Intervals::Between(first, second)
            })
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    /// Asks for a format. The driver may take another one, which comes back.
    pub(crate) fn set_format(&self, fourcc: u32, width: u32, height: u32) -> io::Result<Taken> {
        let mut format = raw::Format::zeroed();
        format.kind = CAPTURE;
        let pix = &mut format.body.pix;
        (pix.width, pix.height, pix.pixelformat) = (width, height, fourcc);
        (pix.field, pix.magic) = (raw::FIELD_NONE, raw::PIX_FORMAT_MAGIC);
        self.call(&raw::S_FMT, &mut format)?;
        let pix = format.body.pix;
        Ok(Taken {
            fourcc: pix.pixelformat,
            width: pix.width,
            height: pix.height,
            step: pix.bytesperline,
            field: pix.field,
            colorspace: pix.colorspace,
            ycbcr_enc: pix.ycbcr_enc,
            quantization: pix.quantization,
        })
    }

    /// Asks for seconds per image; what the driver took comes back, `None` where it sets none.
    pub(crate) fn set_interval(&self, (secs, images): (u32, u32)) -> io::Result<Option<f64>> {
        let mut parameters = raw::StreamParameters::zeroed();
        parameters.kind = CAPTURE;
        parameters.capture.interval = raw::Fraction {
            numerator: secs,
            denominator: images,
        };
        self.call(&raw::S_PARM, &mut parameters)?;
        let taken = parameters.capture.interval;
        let is_set = taken.numerator > 0 && taken.denominator > 0;
        Ok(is_set.then(|| f64::from(taken.denominator) / f64::from(taken.numerator)))
    }

    pub(crate) fn controls(&self) -> Vec<Control> {
        let mut id = 0;
        let ask = |_| {
            let mut query = raw::QueryControl::zeroed();
            query.id = id | raw::NEXT_CONTROL;
            self.call(&raw::QUERYCTRL, &mut query).ok()?;
            id = query.id;
            Some(Control {
                id,
                name: text(&query.name),
                kind: query.kind,
                min: query.minimum,
                max: query.maximum,
                flags: query.flags,
            })
        };
        (0..MAX_LISTED).map_while(ask).collect()
    }

    pub(crate) fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        let mut control = raw::ControlValue { id, value };
        self.call(&raw::S_CTRL, &mut control)
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // A device that is gone may refuse; there is nothing left to close then.
        // SAFETY: opened by `open`, and closed only here.
        unsafe { libc::close(self.fd) };
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
pub(crate) struct Filled {
    index: u32,
    pub n_bytes: usize,
    pub flags: u32,
    pub sequence: u32,
    pub taken_nanos: i64,
}

/// A device that sends images, and the buffers that it fills.
#[derive(Debug)]
pub(crate) struct Stream {
    device: Arc<Device>,
    maps: Vec<Map>,
}

// SAFETY: the maps belong to this struct alone, and their memory may be read from any thread.
unsafe impl Send for Stream {}

impl Stream {
    /// Maps the buffers, hands all of them to the driver and starts it. A fault undoes what was done.
    pub(crate) fn start(device: &Arc<Device>, n_buffers: u32) -> io::Result<Self> {
        let mut request = raw::RequestBuffers::zeroed();
        (request.count, request.kind, request.memory) = (n_buffers, CAPTURE, MMAP);
        device.call(&raw::REQBUFS, &mut request)?;
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
        device.call(&raw::STREAMON, &mut kind)?;
        Ok(stream)
    }

    fn map(&self, index: u32) -> io::Result<Map> {
        let mut buffer = buffer(index);
        self.device.call(&raw::QUERYBUF, &mut buffer)?;
        let offset = libc::off_t::from(buffer.place.offset);
        let n_bytes = buffer.n_bytes as usize;
        let (access, shared) = (libc::PROT_READ, libc::MAP_SHARED);
        // SAFETY: a new mapping at an address of the kernel's choice; it is unmapped once, when the stream ends.
        let start = unsafe {
            libc::mmap(
                ptr::null_mut(),
                n_bytes,
                access,
                shared,
                self.device.fd,
                offset,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(Map { start, n_bytes })
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        self.device.call(&raw::QBUF, &mut buffer(index))
    }

    /// Whether a buffer is filled, or a fault waits to be read, before the time is up.
    pub(crate) fn wait(&self, wait: Duration) -> io::Result<bool> {
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
    pub(crate) fn take(&mut self) -> io::Result<Option<Filled>> {
        let mut buffer = buffer(0);
        match self.device.call(&raw::DQBUF, &mut buffer) {
            Err(e) if e.raw_os_error() == Some(libc::EAGAIN) => return Ok(None),
            done => done?,
        }
        let time = buffer.stamp;
        Ok(Some(Filled {
            index: buffer.index,
            n_bytes: buffer.n_bytes_used as usize,
            flags: buffer.flags,
            sequence: buffer.sequence,
            taken_nanos: nanos(time.secs, time.micros.saturating_mul(1000)),
        }))
    }

    /// What a buffer holds until it is given back.
    pub(crate) fn bytes(&self, filled: &Filled) -> &[u8] {
        let Some(map) = self.maps.get(filled.index as usize) else {
            return &[];
        };
        let n_bytes = filled.n_bytes.min(map.n_bytes);
        // SAFETY: the mapping lives as long as `self` and is at least this long; the driver does not write to a
        // buffer that it has handed out, and giving it back needs `&mut self`.
        unsafe { slice::from_raw_parts(map.start.cast::<u8>(), n_bytes) }
    }

    pub(crate) fn give_back(&mut self, filled: Filled) -> io::Result<()> {
        self.queue(filled.index)
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A device that is gone refuses all of this, and has stopped anyway.
        let mut kind = CAPTURE as c_int;
        self.device.call(&raw::STREAMOFF, &mut kind).ok();
        for map in self.maps.drain(..) {
            // SAFETY: mapped by `map`, and unmapped only here.
            unsafe { libc::munmap(map.start, map.n_bytes) };
        }
        let mut request = raw::RequestBuffers::zeroed();
        (request.kind, request.memory) = (CAPTURE, MMAP);
        self.device.call(&raw::REQBUFS, &mut request).ok();
    }
}

fn buffer(index: u32) -> raw::Buffer {
    let mut buffer = raw::Buffer::zeroed();
    (buffer.index, buffer.kind, buffer.memory) = (index, CAPTURE, MMAP);
    buffer
}

/// The kernel's monotonic clock, which stamps images, before and after its wall clock.
pub(crate) fn read_clocks() -> ClockReading {
    let read = |clock| {
        let mut time = libc::timespec {
            tv_sec: 0,
            tv_nsec: 0,
        };
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
