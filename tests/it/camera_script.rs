//! A camera that plays a script: what drivers do, without a driver.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use splat_image::pixel_format::{PixelFormat, YuvColour};
use splat_io::camera::driver::{Camera, CapturedImage, Coding, Layout};
use splat_io::camera::live::Opener;
use splat_io::camera::stamps::ClockReading;
use splat_io::camera_error::CameraError;
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch, monotonic_nanos};

const PACE: Duration = Duration::from_millis(10);

/// What the camera does next.
#[derive(Debug, Clone)]
pub enum Step {
    /// An image; without bytes the camera's plain one.
    Image {
        sequence: u32,
        /// Before it is handed out.
        age_nanos: i64,
        is_damaged: bool,
        bytes: Option<Vec<u8>>,
    },
    /// The read fails, and opening again does for so long.
    Unplugged { secs: f64 },
    /// No image for ever, until it is opened again.
    Hang,
}

pub fn test_image(sequence: u32) -> Step {
    Step::Image {
        sequence,
        age_nanos: 0,
        is_damaged: false,
        bytes: None,
    }
}

#[derive(Debug)]
struct Stage {
    steps: VecDeque<Step>,
    gone: Option<(Stopwatch, f64)>,
    n_openings: usize,
    /// When it could be opened again.
    returned: Option<Stopwatch>,
    clock: Clock,
}

/// `Real`, or one that stands at the time of the newest image.
#[derive(Debug, Clone, Copy)]
pub enum Clock {
    Real,
    Nanos(i64),
}

/// Shared by the openings of one camera.
#[derive(Debug, Clone)]
pub struct Script {
    stage: Arc<Mutex<Stage>>,
    pub layout: Layout,
}

impl Script {
    pub fn new(layout: Layout, clock: Clock, steps: impl IntoIterator<Item = Step>) -> Self {
        Self {
            stage: Arc::new(Mutex::new(Stage {
                steps: steps.into_iter().collect(),
                gone: None,
                n_openings: 0,
                returned: None,
                clock,
            })),
            layout,
        }
    }

    pub fn opener(&self) -> Opener {
        let script = self.clone();
        Box::new(move || script.open())
    }

    fn open(&self) -> Result<Box<dyn Camera>, CameraError> {
        let mut stage = self.stage.lock().unwrap();
        if let Some((watch, secs)) = stage.gone {
            if watch.secs() < secs {
                return Err(CameraError::Absent {
                    path: "/dev/video9".into(),
                });
            }
            stage.gone = None;
            stage.returned = Some(Stopwatch::start());
        }
        stage.n_openings += 1;
        Ok(Box::new(Scripted {
            script: self.clone(),
            is_hanging: false,
            bytes: vec![100; (3 * self.layout.width_px * self.layout.height_px) as usize],
        }))
    }

    pub fn n_openings(&self) -> usize {
        self.stage.lock().unwrap().n_openings
    }

    pub fn is_played(&self) -> bool {
        self.stage.lock().unwrap().steps.is_empty()
    }
}

struct Scripted {
    script: Script,
    is_hanging: bool,
    bytes: Vec<u8>,
}

impl Camera for Scripted {
    fn layout(&self) -> Layout {
        self.script.layout
    }

    fn next(&mut self, wait: Duration) -> Result<Option<CapturedImage<'_>>, CameraError> {
        let mut stage = self.script.stage.lock().unwrap();
        if self.is_hanging || stage.steps.is_empty() {
            drop(stage);
            std::thread::sleep(wait);
            return Ok(None);
        }
        match stage.steps.pop_front().unwrap() {
            Step::Image {
                sequence,
                age_nanos,
                is_damaged,
                bytes,
            } => {
                if let Clock::Nanos(nanos) = &mut stage.clock {
                    *nanos += 100_000_000;
                }
                drop(stage);
                // A camera has a rate; a recording must keep up with it.
                std::thread::sleep(PACE);
                let now = self.read_clocks();
                if let Some(bytes) = bytes {
                    self.bytes = bytes;
                }
                Ok(Some(CapturedImage {
                    bytes: &self.bytes,
                    sequence: Some(sequence),
                    taken_nanos: Some(now.after_nanos - age_nanos),
                    is_damaged,
                    now,
                }))
            }
            Step::Unplugged { secs } => {
                stage.gone = Some((Stopwatch::start(), secs));
                Err(CameraError::Gone {
                    reason: "No such device".to_owned(),
                    path: "/dev/video9".into(),
                })
            }
            Step::Hang => {
                self.is_hanging = true;
                Ok(None)
            }
        }
    }

    fn read_clocks(&self) -> ClockReading {
        match self.script.stage.lock().unwrap().clock {
            Clock::Real => {
                let before_nanos = monotonic_nanos();
                ClockReading {
                    before_nanos,
                    wall: Stamp::now(),
                    after_nanos: monotonic_nanos(),
                }
            }
            Clock::Nanos(nanos) => ClockReading {
                before_nanos: nanos,
                wall: Stamp::from_nanos(nanos + 1_000_000_000_000),
                after_nanos: nanos,
            },
        }
    }
}

pub fn layout(format: PixelFormat, (width_px, height_px): (u32, u32)) -> Layout {
    Layout {
        width_px,
        height_px,
        coding: Coding::Raw(format, YuvColour::default()),
        step: 0,
        rate_hz: Some(30.0),
    }
}

/// Images as a camera with RGB pixels sends them, `unplugged` for a while before the one of that number.
pub fn steps_of(images: &[RgbImage], unplugged: Option<usize>) -> Vec<Step> {
    let mut steps = Vec::new();
    for (ix, test_image) in images.iter().enumerate() {
        if unplugged == Some(ix) {
            steps.push(Step::Unplugged { secs: 0.5 });
        }
        steps.push(Step::Image {
            sequence: ix as u32,
            age_nanos: 0,
            is_damaged: false,
            bytes: Some(test_image.pixels.clone()),
        });
    }
    steps
}
