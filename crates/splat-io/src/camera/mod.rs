//! Live cameras whatever their driver: modes, time stamps, loss and return of the device.

pub mod stamps;

pub mod driver;

pub mod live;

pub mod source;

pub mod modes;
