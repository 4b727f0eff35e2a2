//! What the viewer's server is asked to do.

use std::net::SocketAddr;
use std::path::PathBuf;

/// How connections are encrypted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Tls {
    Off,
    /// A certificate made at the start; browsers ask once.
    SelfSigned,
    Files {
        certificate: PathBuf,
        key: PathBuf,
    },
}

/// Of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewSettings {
    pub address: SocketAddr,
    /// Whether another port is taken where that of the address is in use.
    pub may_take_another_port: bool,
    /// What a browser must bring; `None` lets everybody in who can connect.
    pub token: Option<String>,
    pub tls: Tls,
    pub max_clients: usize,
    /// Harmonics beyond are left out.
    pub sh_degree: u8,
    /// For the page: `live`, `map` or `recording`, and what it shows.
    pub source: &'static str,
    pub title: String,
    /// Name of the robot's map frame.
    pub map_frame: String,
}
