//! Parameters -> the viewer's server, its address said and opened where there is a desktop.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use anyhow::{Context as _, bail};

use crate::node::job;
use splat_ros::params::PublishParams;
use splat_view::settings::{Tls, ViewSettings};
use splat_view::transport::ViewTransport;

/// Where `--view` without an address listens; another port of it where that one is in use.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:8642";

/// What a viewer shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// A map that grows.
    Live,
    /// One that stays as it is.
    Map,
    /// What a recording holds.
    Recording,
}

/// `None` where `publish.view` is empty.
pub fn settings(
    params: &PublishParams,
    shown: Shown,
    title: &str,
) -> anyhow::Result<Option<ViewSettings>> {
    if params.view.is_empty() {
        return Ok(None);
    }
    let address = address(&params.view)?;
    let tls = tls(&params.view_tls)?;
    let is_open = !address.ip().is_loopback();
    let token = match params.view_token.as_str() {
        "" if is_open => Some(random_token()),
        "" => None,
        given => Some(checked_token(given)?.to_owned()),
    };
    if is_open && tls == Tls::Off {
        tracing::warn!(
            "the viewer listens on {address} without encryption: everybody on the way can read the token and the map, and headsets offer no VR; publish.view_tls=self_signed encrypts"
        );
    }
    Ok(Some(ViewSettings {
        address,
        may_take_another_port: params.view == DEFAULT_ADDRESS,
        token,
        tls,
        max_clients: params.view_clients,
        sh_degree: params.view_sh_degree,
        source: match shown {
            Shown::Live => "live",
            Shown::Map => "map",
            Shown::Recording => "recording",
        },
        title: title.to_owned(),
        map_frame: params.map_frame.clone(),
    }))
}

/// Listens, says where, and opens a browser where there is a desktop and `opens`.
pub fn start(
    params: &PublishParams,
    shown: Shown,
    title: &str,
    opens: bool,
) -> anyhow::Result<Option<ViewTransport>> {
    let Some(settings) = settings(params, shown, title)? else {
        return Ok(None);
    };
    let viewer = ViewTransport::start(&settings).context("the viewer does not start")?;
    tracing::info!("look at the map: {}", viewer.url());
    if opens && has_desktop() {
        open_browser(viewer.url());
    }
    Ok(Some(viewer))
}

/// An address, a port, or both; `localhost` is the machine itself.
fn address(text: &str) -> anyhow::Result<SocketAddr> {
    let named = text.replacen("localhost", "127.0.0.1", 1);
    if let Ok(address) = named.parse::<SocketAddr>() {
        return Ok(address);
    }
    if let Ok(ip) = named.parse::<IpAddr>() {
        return Ok(SocketAddr::new(ip, default_port()));
    }
    match named.trim_start_matches(':').parse::<u16>() {
        Ok(port) => Ok(SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port)),
        Err(_) => bail!(
            "publish.view = {text:?}, expected ADDRESS:PORT, such as 127.0.0.1:8642, or 0.0.0.0:8642 for other machines"
        ),
    }
}

fn default_port() -> u16 {
    DEFAULT_ADDRESS
        .parse()
        .map_or(0, |address: SocketAddr| address.port())
}

fn tls(text: &str) -> anyhow::Result<Tls> {
    match text {
        "off" => Ok(Tls::Off),
        "self_signed" => Ok(Tls::SelfSigned),
        _ => match text.split_once(',') {
            Some((certificate, key)) => Ok(Tls::Files {
                certificate: PathBuf::from(certificate),
                key: PathBuf::from(key),
            }),
            None => bail!(
                "publish.view_tls = {text:?}, expected off, self_signed, or CERTIFICATE.pem,KEY.pem"
            ),
        },
    }
}

fn checked_token(token: &str) -> anyhow::Result<&str> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.~".contains(c);
    if token.len() < 8 || !token.chars().all(is_plain) {
        bail!(
            "publish.view_token: expected 8 or more letters, digits, or - _ . ~, since it stands in an address"
        );
    }
    Ok(token)
}

fn random_token() -> String {
    format!("{:032x}", rand::random::<u128>())
}

fn has_desktop() -> bool {
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    cfg!(any(target_os = "macos", windows)) || is_set("DISPLAY") || is_set("WAYLAND_DISPLAY")
}

/// Whoever has no browser sees the address in the log.
fn open_browser(url: &str) {
    let program = if cfg!(target_os = "macos") {
        "open"
    } else if cfg!(windows) {
        "explorer"
    } else {
        "xdg-open"
    };
    let spawned = std::process::Command::new(program)
        .arg(url)
        .stdin(std::process::Stdio::null())
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn();
    if let Ok(mut child) = spawned {
        // Waited for, so that it does not stay as a zombie.
        job::spawn("browser", move || child.wait().ok()).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_as_people_write_them() {
        let read = |text: &str| address(text).unwrap().to_string();
        assert_eq!(read("0.0.0.0:80"), "0.0.0.0:80");
        assert_eq!(read("localhost:9000"), "127.0.0.1:9000");
        assert_eq!(read("9000"), "127.0.0.1:9000");
        assert_eq!(read(":9000"), "127.0.0.1:9000");
        assert_eq!(read("192.168.1.7"), "192.168.1.7:8642");
        assert_eq!(read("[::1]:9000"), "[::1]:9000");
        for wrong in ["robot:9000", "http://localhost", "70000", ""] {
            assert!(address(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn other_machines_need_a_token_and_get_one() {
        let with = |view: &str, token: &str| {
            let params = PublishParams {
                view: view.to_owned(),
                view_token: token.to_owned(),
                ..PublishParams::default()
            };
            settings(&params, Shown::Live, "")
        };
        assert_eq!(with("", "").unwrap(), None);
        assert_eq!(with("127.0.0.1:0", "").unwrap().unwrap().token, None);
        let open = with("0.0.0.0:0", "").unwrap().unwrap().token.unwrap();
        assert_eq!(open.len(), 32);
        let again = with("0.0.0.0:0", "").unwrap().unwrap().token.unwrap();
        assert_ne!(open, again);
        assert!(with("127.0.0.1:0", "a b").is_err());
        assert!(with("127.0.0.1:0", "short").is_err());
    }
}
