//! What linux/videodev2.h defines of single-planar capture: structs, numbers of the calls. A test compares them with the
//! header.
//!
//! Where the header has a union, the struct has the one variant that is used, and fills the rest. Fields of the type
//! `[usize; 0]` take no room; they align what they stand in as the pointers of the unused variants do.

use std::marker::PhantomData;
use std::os::raw::c_int;

use bytemuck::Zeroable;

pub(crate) const BUFFER_TYPE_VIDEO_CAPTURE: u32 = 1;
pub(crate) const MEMORY_MMAP: u32 = 1;
pub(crate) const FIELD_NONE: u32 = 1;
pub(crate) const SIZE_IS_DISCRETE: u32 = 1;
pub(crate) const INTERVAL_IS_DISCRETE: u32 = 1;
pub(crate) const HAS_DEVICE_CAPS: u32 = 0x8000_0000;
/// Makes the driver fill in what YUV numbers mean.
pub(crate) const PIX_FORMAT_MAGIC: u32 = 0xfeed_cafe;
/// Beside the id of a control: asks for the next one.
pub(crate) const NEXT_CONTROL: u32 = 0x8000_0000;

/// A call that reads and writes a `T`.
#[derive(Debug)]
pub(crate) struct Call<T> {
    number: libc::Ioctl,
    argument: PhantomData<T>,
}

impl<T> Call<T> {
    const fn writing(nr: u32) -> Self {
        Self {
            number: libc::_IOW::<T>(GROUP, nr),
            argument: PhantomData,
        }
    }

    const fn reading(nr: u32) -> Self {
        Self {
            number: libc::_IOR::<T>(GROUP, nr),
            argument: PhantomData,
        }
    }

    const fn both(nr: u32) -> Self {
        Self {
            number: libc::_IOWR::<T>(GROUP, nr),
            argument: PhantomData,
        }
    }

    /// Names the call and the size of its argument.
    pub(crate) fn number(&self) -> libc::Ioctl {
        self.number
    }
}

const GROUP: u32 = b'V' as u32;

pub(crate) const QUERYCAP: Call<Capability> = Call::reading(0);
pub(crate) const ENUM_FMT: Call<FormatDescription> = Call::both(2);
pub(crate) const S_FMT: Call<Format> = Call::both(5);
pub(crate) const REQBUFS: Call<RequestBuffers> = Call::both(8);
pub(crate) const QUERYBUF: Call<Buffer> = Call::both(9);
pub(crate) const QBUF: Call<Buffer> = Call::both(15);
pub(crate) const DQBUF: Call<Buffer> = Call::both(17);
pub(crate) const STREAMON: Call<c_int> = Call::writing(18);
pub(crate) const STREAMOFF: Call<c_int> = Call::writing(19);
pub(crate) const S_PARM: Call<StreamParameters> = Call::both(22);
pub(crate) const S_CTRL: Call<ControlValue> = Call::both(28);
pub(crate) const QUERYCTRL: Call<QueryControl> = Call::both(36);
pub(crate) const ENUM_FRAMESIZES: Call<FrameSize> = Call::both(74);
pub(crate) const ENUM_FRAMEINTERVALS: Call<FrameInterval> = Call::both(75);

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct Capability {
    pub driver: [u8; 16],
    pub card: [u8; 32],
    pub bus_info: [u8; 32],
    pub version: u32,
    pub capabilities: u32,
    pub device_caps: u32,
    pub reserved: [u32; 3],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct FormatDescription {
    pub index: u32,
    pub kind: u32,
    pub flags: u32,
    pub description: [u8; 32],
    pub pixelformat: u32,
    pub mbus_code: u32,
    pub reserved: [u32; 3],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct FrameSize {
    pub index: u32,
    pub pixel_format: u32,
    pub kind: u32,
    /// Width and height; or smallest, largest and step of the width, and the same of the height.
    pub sizes: [u32; 6],
    pub reserved: [u32; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Zeroable)]
#[repr(C)]
pub(crate) struct Fraction {
    pub numerator: u32,
    pub denominator: u32,
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct FrameInterval {
    pub index: u32,
    pub pixel_format: u32,
    pub width: u32,
    pub height: u32,
    pub kind: u32,
    /// One interval in seconds; or shortest, longest and step.
    pub intervals: [Fraction; 3],
    pub reserved: [u32; 2],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct Format {
    pub kind: u32,
    pub body: FormatBody,
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct FormatBody {
    pub pix: PixFormat,
    rest: [u8; 200 - size_of::<PixFormat>()],
    align: [usize; 0],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct PixFormat {
    pub width: u32,
    pub height: u32,
    pub pixelformat: u32,
    pub field: u32,
    pub bytesperline: u32,
    pub sizeimage: u32,
    pub colorspace: u32,
    pub magic: u32,
    pub flags: u32,
    pub ycbcr_enc: u32,
    pub quantization: u32,
    pub xfer_func: u32,
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct StreamParameters {
    pub kind: u32,
    pub capture: CaptureParameters,
    rest: [u8; 200 - size_of::<CaptureParameters>()],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct CaptureParameters {
    pub capability: u32,
    pub mode: u32,
    /// Seconds per image.
    pub interval: Fraction,
    pub extended_mode: u32,
    pub read_buffers: u32,
    pub reserved: [u32; 4],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct QueryControl {
    pub id: u32,
    pub kind: u32,
    pub name: [u8; 32],
    pub minimum: i32,
    pub maximum: i32,
    pub step: i32,
    pub default_value: i32,
    pub flags: u32,
    pub reserved: [u32; 2],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct ControlValue {
    pub id: u32,
    pub value: i32,
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct RequestBuffers {
    pub count: u32,
    pub kind: u32,
    pub memory: u32,
    pub capabilities: u32,
    /// One byte of flags.
    pub reserved: [u8; 4],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct Buffer {
    pub index: u32,
    pub kind: u32,
    pub n_bytes_used: u32,
    pub flags: u32,
    pub field: u32,
    pub stamp: TimeValue,
    /// Four numbers of a tape's time code.
    pub time_code: [u32; 4],
    pub sequence: u32,
    pub memory: u32,
    pub place: Place,
    pub n_bytes: u32,
    pub reserved: [u32; 2],
}

#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct TimeValue {
    pub secs: libc::time_t,
    pub micros: libc::suseconds_t,
}

/// Where mapped memory begins, as `mmap` is reported.
#[derive(Debug, Clone, Copy, Zeroable)]
#[repr(C)]
pub(crate) struct Place {
    pub offset: u32,
    align: [usize; 0],
}

#[cfg(test)]
mod tests;
