//! A lost device -> the map on another engine, or the end of the run.
//!
//! Nothing that is read after a fault is published or saved: the map goes on from its last good state.

use std::time::Duration;

use crate::node::engines::{Engines, Kind, kind_of};
use crate::node::stop::Stop;
use crate::params::engine_params::OnDeviceLost;
use crate::params::params::Params;
use splat_engine::error::EngineError;
use splat_gpu::backend::Backend;
use splat_slam::mapper::mapper::Mapper;
use splat_types::time::Stopwatch;

/// Waits before each try of the same backend: a driver that has been reset is there again after some seconds.
const WAITS: [Duration; 3] = [
    Duration::ZERO,
    Duration::from_secs(1),
    Duration::from_secs(2),
];
/// No try begins later.
const MAX_TRY_SECS: f64 = 7.0;
/// A device that is lost again so soon is lost for good.
const MIN_SECS_BETWEEN: f64 = 60.0;

/// What to do about faults, and what has been done.
#[derive(Debug)]
pub(crate) struct Recovery {
    engines: Engines,
    backend: Backend,
    deterministic: bool,
    policy: OnDeviceLost,
    pub(crate) stop: Stop,
    since_fault: Option<Stopwatch>,
    pub(crate) n_faults: u64,
    /// Why mapping has ended.
    pub(crate) error: Option<String>,
}

impl Recovery {
    /// A deterministic replay cannot go on: how far the steps had come would show in the map.
    pub(crate) fn new(params: &Params, is_live: bool, engines: Engines, stop: Stop) -> Self {
        let policy = if params.deterministic && !is_live {
            OnDeviceLost::Stop
        } else {
            params.engine.on_device_lost
        };
        Self {
            engines,
            backend: params.backend,
            deterministic: params.deterministic,
            policy,
            stop,
            since_fault: None,
            n_faults: 0,
            error: None,
        }
    }

    /// Puts the map on another engine; else `error` says why not, and the input is asked to end.
    pub(crate) fn recover(&mut self, map: &mut Mapper, error: &EngineError) {
        self.n_faults += 1;
        let why = self.attempt(map, error).err();
        self.since_fault = Some(Stopwatch::start());
        if let Some(why) = why {
            tracing::error!("engine: {error}; mapping ends: {why}");
            self.error = Some(format!("engine: {error}; {why}"));
            self.stop.ask();
        }
    }

    fn attempt(&self, map: &mut Mapper, error: &EngineError) -> Result<(), String> {
        if !matches!(error, EngineError::DeviceLost { .. }) {
            return Err("the map cannot grow further".to_owned());
        }
        if self.policy == OnDeviceLost::Stop {
            return Err("engine.on_device_lost is stop, or the replay is deterministic".to_owned());
        }
        let is_recent = |since: &Stopwatch| since.secs() < MIN_SECS_BETWEEN;
        if self.since_fault.as_ref().is_some_and(is_recent) {
            return Err(format!(
                "it is the second loss within {MIN_SECS_BETWEEN:.0} s"
            ));
        }
        if !map.can_recover() {
            return Err("there was no map yet".to_owned());
        }
        tracing::warn!("engine: {error}; mapping goes on from the last good state");
        if self.policy == OnDeviceLost::Restart && self.restart(map) {
            return Ok(());
        }
        let engine = self.engines.open(Kind::Cpu, self.deterministic);
        let engine = engine.map_err(|error| error.to_string())?;
        map.recover(engine).map_err(|error| error.to_string())?;
        tracing::warn!("engine: mapping goes on with {}", map.adapter());
        Ok(())
    }

    /// The same backend again; whether the map is on it.
    fn restart(&self, map: &mut Mapper) -> bool {
        let watch = Stopwatch::start();
        for wait in WAITS {
            if self.stop.is_asked() || watch.secs() + wait.as_secs_f64() > MAX_TRY_SECS {
                break;
            }
            std::thread::sleep(wait);
            let opened = self.engines.open(kind_of(self.backend), self.deterministic);
            let error = match opened {
                Err(error) => error.to_string(),
                Ok(engine) => match map.recover(engine) {
                    Ok(()) => {
                        tracing::info!("engine: mapping goes on with {}", map.adapter());
                        return true;
                    }
                    Err(error) => error.to_string(),
                },
            };
            tracing::warn!("engine: no restart: {error}");
        }
        false
    }
}
