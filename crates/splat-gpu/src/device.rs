//! An adapter -> a device that compiles the table's shaders on first use and makes buffers.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytemuck::Pod;

use crate::buffer::{Buffer, Meter};
use crate::error::GpuError;
use crate::fault::Fault;
use crate::kernel::{Access, Kernel, Lanes};
use crate::profile::{KernelTime, MAX_TIMED, Profile};

/// A device that has not finished by then never will.
const MAX_WAIT_SECS: u64 = 120;
/// Lanes of a tile where subgroups are of no use: narrow enough that 8 pixels a lane stay in registers.
const PLAIN_LANES: u32 = 32;
/// Smallest buffer that may be bound.
const MIN_BYTES: u64 = 16;

/// What to ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    /// Software adapters (lavapipe) too: for tests, and when a user insists.
    pub any_kind: bool,
    /// false: behave as on an adapter without subgroup operations, for tests.
    pub subgroups: bool,
    /// Sums of floats in any order where the adapter can: faster, but not twice the same.
    pub float_atomics: bool,
    /// Threads of a tile, a divisor of 256; `None`: what suits the adapter.
    pub lanes: Option<u32>,
}

/// A device and what is compiled for it. One thread owns it.
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    name: String,
    limits: wgpu::Limits,
    lanes: Lanes,
    has_float_atomics: bool,
    pipelines: RefCell<HashMap<&'static str, Arc<Pipeline>>>,
    /// By kernel and buffers.
    pub(crate) bind_groups: RefCell<HashMap<(&'static str, Vec<u64>), wgpu::BindGroup>>,
    meter: Arc<Meter>,
    pub(crate) profile: RefCell<Option<Profile>>,
    fault: Fault,
}

/// A compiled kernel.
#[derive(Debug)]
pub(crate) struct Pipeline {
    pub(crate) compute: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Gpu({}, {:?})", self.name, self.lanes)
    }
}

impl Gpu {
    /// One at a time in a process: drivers have crashed where threads opened theirs side by side.
    pub fn open(wanted: Wanted) -> Result<Self, GpuError> {
        static OPENING: Mutex<()> = Mutex::new(());
        // Nothing is left half done by a panic in there.
        let _alone = OPENING.lock().unwrap_or_else(PoisonError::into_inner);
        pollster::block_on(open(wanted))
    }

    /// For logs and reports.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub fn lanes(&self) -> Lanes {
        self.lanes
    }

    /// Of the adapter; the device was opened with all of them.
    pub fn limits(&self) -> &wgpu::Limits {
        &self.limits
    }

    /// Asked for, and there.
    pub fn has_float_atomics(&self) -> bool {
        self.has_float_atomics
    }

    pub fn meter(&self) -> &Meter {
        &self.meter
    }

    /// Most bytes that a buffer may have which a shader reads.
    pub fn max_buffer_bytes(&self) -> u64 {
        self.limits
            .max_storage_buffer_binding_size
            .min(self.limits.max_buffer_size)
    }

    /// Zeroed storage for `n` numbers of type T.
    pub fn storage<T: Pod>(&self, label: &'static str, n: usize) -> Result<Buffer, GpuError> {
        let n_bytes = (n as u64)
            .saturating_mul(size_of::<T>() as u64)
            .max(MIN_BYTES);
        if n_bytes > self.max_buffer_bytes() {
            return Err(GpuError::TooLarge {
                what: label,
                needed: n_bytes,
                limit: self.max_buffer_bytes(),
                adapter: self.name.clone(),
            });
        }
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::INDIRECT
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST;
        Ok(self.buffer(label, n_bytes, usage))
    }

    /// Storage that holds `values`.
    pub fn storage_of<T: Pod>(
        &self,
        label: &'static str,
        values: &[T],
    ) -> Result<Buffer, GpuError> {
        let buffer = self.storage::<T>(label, values.len())?;
        self.write(&buffer, 0, values);
        Ok(buffer)
    }

    /// A uniform that holds `value`.
    pub fn uniform<T: Pod>(&self, label: &'static str, value: &T) -> Buffer {
        let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
        let buffer = self.buffer(label, size_of::<T>() as u64, usage);
        self.write(&buffer, 0, std::slice::from_ref(value));
        buffer
    }

    /// Overwrites values from the `first` on, in order with submitted work.
    pub fn write<T: Pod>(&self, buffer: &Buffer, first: usize, values: &[T]) {
        if !values.is_empty() {
            let offset = (first * size_of::<T>()) as u64;
            self.queue
                .write_buffer(&buffer.raw, offset, bytemuck::cast_slice(values));
        }
    }

    /// Waits for all submitted work and reads values back.
    pub fn read<T: Pod>(&self, buffer: &Buffer, range: Range<usize>) -> Result<Vec<T>, GpuError> {
        self.check()?;
        let n_bytes = (range.len() * size_of::<T>()) as u64;
        if n_bytes == 0 {
            return Ok(Vec::new());
        }
        let staging = self.staging(n_bytes);
        let mut encoder = self
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let offset = (range.start * size_of::<T>()) as u64;
        encoder.copy_buffer_to_buffer(&buffer.raw, offset, &staging.raw, 0, n_bytes);
        self.queue.submit([encoder.finish()]);
        // Work that was refused leaves zeros, and waiting for a device that is lost is a panic of wgpu.
        self.check()?;
        let slice = staging.raw.slice(..n_bytes);
        slice.map_async(wgpu::MapMode::Read, |_| {});
        self.wait()?;
        let view = slice.get_mapped_range().map_err(|error| {
            tracing::error!("reading from {}: {error}", self.name);
            self.hangs()
        })?;
        self.check()?;
        Ok(bytemuck::pod_collect_to_vec(&view[..]))
    }

    /// An error once anything was refused or the device was lost.
    pub fn check(&self) -> Result<(), GpuError> {
        self.fault.check(&self.name)?;
        // A loss is reported by a poll alone; this one waits for nothing.
        self.poll(wgpu::PollType::Poll)?;
        self.fault.check(&self.name)
    }

    /// As when the adapter is unplugged: for tests.
    pub fn lose(&self) {
        self.device.destroy();
    }

    /// Memory that the host can map.
    pub fn staging(&self, n_bytes: u64) -> Buffer {
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        self.buffer("staging", n_bytes, usage)
    }

    /// Until all submitted work is done.
    pub fn wait(&self) -> Result<(), GpuError> {
        let poll = wgpu::PollType::Wait {
            submission_index: None,
            timeout: Some(Duration::from_secs(MAX_WAIT_SECS)),
        };
        self.poll(poll)
    }

    /// wgpu panics where the driver reports the loss while it is polled; nothing of ours is left half done by that.
    fn poll(&self, poll: wgpu::PollType) -> Result<(), GpuError> {
        match catch_unwind(AssertUnwindSafe(|| self.device.poll(poll))) {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(error)) => {
                tracing::error!("waiting for {}: {error}", self.name);
                Err(self.hangs())
            }
            Err(_) => {
                self.fault.note("the driver lost the device");
                self.fault.check(&self.name)
            }
        }
    }

    /// Times every dispatch from now on, each in a pass of its own and each submission waited for: the sum is that of
    /// kernels without what they gain from running side by side. False where the adapter has no timestamps.
    pub fn start_profile(&self) -> bool {
        if !self
            .device
            .features()
            .contains(wgpu::Features::TIMESTAMP_QUERY)
        {
            return false;
        }
        let n = 2 * MAX_TIMED as u32;
        let queries = self.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("timestamps"),
            ty: wgpu::QueryType::Timestamp,
            count: n,
        });
        let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
        *self.profile.borrow_mut() = Some(Profile {
            queries,
            ticks: self.buffer("timestamps", 8 * u64::from(n), usage),
            secs_per_tick: 1e-9 * f64::from(self.queue.get_timestamp_period()),
            times: BTreeMap::new(),
        });
        true
    }

    /// Ends the profile: time by kernel since it was started, the slowest first.
    pub fn take_profile(&self) -> Vec<(&'static str, KernelTime)> {
        let profile = self.profile.borrow_mut().take();
        let mut times: Vec<_> = profile.into_iter().flat_map(|p| p.times).collect();
        times.sort_by(|a, b| b.1.secs.total_cmp(&a.1.secs));
        times
    }

    /// Buffers were replaced: bindings of the old ones would keep them alive.
    pub fn forget_bindings(&self) {
        self.bind_groups.borrow_mut().clear();
    }

    /// Compiles all of these, so that a fault shows at the start and no step waits for it.
    pub fn compile(&self, kernels: &[&'static Kernel]) -> Result<(), GpuError> {
        kernels
            .iter()
            .filter(|kernel| kernel.suits(self.lanes))
            .try_for_each(|kernel| self.pipeline(kernel).map(drop))
    }

    pub(crate) fn pipeline(&self, kernel: &'static Kernel) -> Result<Arc<Pipeline>, GpuError> {
        if let Some(pipeline) = self.pipelines.borrow().get(kernel.name) {
            return Ok(Arc::clone(pipeline));
        }
        let pipeline = Arc::new(self.compiled(kernel)?);
        self.pipelines
            .borrow_mut()
            .insert(kernel.name, Arc::clone(&pipeline));
        Ok(pipeline)
    }

    fn compiled(&self, kernel: &'static Kernel) -> Result<Pipeline, GpuError> {
        let fault = |reason: String| GpuError::Shader {
            name: kernel.name,
            adapter: self.name.clone(),
            reason,
        };
        let text = kernel
            .text(self.lanes)
            .ok_or_else(|| fault("an import or repetition is broken".to_owned()))?;
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let module = self
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(kernel.name),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
        let entries: Vec<_> = kernel.bindings.iter().zip(0..).map(layout_entry).collect();
        let layout = self
            .device
            .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
                label: Some(kernel.name),
                entries: &entries,
            });
        let pipeline_layout = self
            .device
            .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(kernel.name),
                bind_group_layouts: &[Some(&layout)],
                immediate_size: 0,
            });
        let compute = self
            .device
            .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(kernel.name),
                layout: Some(&pipeline_layout),
                module: &module,
                entry_point: Some("main"),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &[],
                    // Every kernel writes workgroup memory before it reads it.
                    zero_initialize_workgroup_memory: false,
                },
                cache: None,
            });
        match pollster::block_on(scope.pop()) {
            None => Ok(Pipeline { compute, layout }),
            Some(error) => Err(fault(error.to_string())),
        }
    }

    fn buffer(&self, label: &'static str, n_bytes: u64, usage: wgpu::BufferUsages) -> Buffer {
        let raw = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            // Copies come in words.
            size: n_bytes.next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT),
            usage,
            mapped_at_creation: false,
        });
        Buffer::new(raw, &self.meter)
    }

    fn hangs(&self) -> GpuError {
        GpuError::Hangs {
            adapter: self.name.clone(),
            secs: MAX_WAIT_SECS,
        }
    }
}

fn layout_entry(
    ((_, access), binding): (&(&'static str, Access), u32),
) -> wgpu::BindGroupLayoutEntry {
    let ty = match access {
        Access::Uniform => wgpu::BufferBindingType::Uniform,
        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
        Access::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
    };
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer {
            ty,
            has_dynamic_offset: false,
            min_binding_size: None,
        },
        count: None,
    }
}

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    // The kernels write their own dispatch sizes and keep them within the limits.
    descriptor
        .flags
        .remove(wgpu::InstanceFlags::VALIDATION_INDIRECT_CALL);
    wgpu::Instance::new(descriptor)
}

/// The fastest kind that is wanted.
async fn best_adapter(instance: &wgpu::Instance, any_kind: bool) -> Option<wgpu::Adapter> {
    let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    };
    let adapters = instance.enumerate_adapters(wgpu::Backends::PRIMARY).await;
    adapters
        .into_iter()
        .filter(|adapter| any_kind || rank(adapter) < 3)
        .min_by_key(rank)
}

async fn open(wanted: Wanted) -> Result<Gpu, GpuError> {
    let adapter = best_adapter(&instance(), wanted.any_kind)
        .await
        .ok_or(GpuError::NoAdapter {
            any_kind: wanted.any_kind,
        })?;
    let info = adapter.get_info();
    let has_subgroups = wanted.subgroups && adapter.features().contains(wgpu::Features::SUBGROUP);
    let has_float_atomics = wanted.float_atomics
        && adapter
            .features()
            .contains(wgpu::Features::SHADER_FLOAT32_ATOMIC);
    let mut required_features = wgpu::Features::empty();
    required_features.set(wgpu::Features::SUBGROUP, has_subgroups);
    required_features.set(wgpu::Features::SHADER_FLOAT32_ATOMIC, has_float_atomics);
    required_features |= adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
    let limits = adapter.limits();
    let descriptor = wgpu::DeviceDescriptor {
        label: Some("splat-mapper"),
        required_features,
        required_limits: limits.clone(),
        ..wgpu::DeviceDescriptor::default()
    };
    let (device, queue) =
        adapter
            .request_device(&descriptor)
            .await
            .map_err(|e| GpuError::NoDevice {
                adapter: info.name.clone(),
                reason: e.to_string(),
            })?;
    let fault = Fault::watching(&device);
    let mut name = info.name.clone();
    // Writing to a string cannot fail.
    let _infallible = write!(name, " ({:?}, {})", info.backend, info.driver_info);
    Ok(Gpu {
        device,
        queue,
        name,
        limits,
        lanes: lanes(&info, has_subgroups, wanted.lanes),
        has_float_atomics,
        pipelines: RefCell::default(),
        bind_groups: RefCell::default(),
        meter: Arc::default(),
        profile: RefCell::default(),
        fault,
    })
}

/// Subgroups where their size is known before a shader is compiled, else workgroup memory.
fn lanes(info: &wgpu::AdapterInfo, has_subgroups: bool, wanted: Option<u32>) -> Lanes {
    let n = info.subgroup_min_size;
    let is_fixed = n == info.subgroup_max_size && (4..=128).contains(&n);
    if has_subgroups && is_fixed {
        Lanes {
            // As wide as a subgroup at least.
            n: wanted.unwrap_or(default_lanes(n)).max(n),
            subgroup: Some(n),
        }
    } else {
        Lanes {
            n: wanted.unwrap_or(PLAIN_LANES),
            subgroup: None,
        }
    }
}

/// Two subgroups where they are of 32: on an H100 steps at 270x480 are 9 % faster than with one, at 1920x1080 5 % slower,
/// and images are small more often (docs/gpu). Narrower ones are software's.
fn default_lanes(subgroup: u32) -> u32 {
    if subgroup == 32 { 64 } else { subgroup }
}
