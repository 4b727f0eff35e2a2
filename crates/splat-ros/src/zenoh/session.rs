//! `publish.*` parameters -> an open zenoh session and the endpoints that it listens on.

use std::path::Path;
use std::time::Duration;

use zenoh::{Config, Session, Wait};

use crate::error::PublishError;
use crate::params::PublishParams;

/// A peer that takes in nothing for so long while we wait is cut off; it may connect again.
const MAX_BLOCKED: Duration = Duration::from_secs(2);
/// Another program may take a port between our looking for it and zenoh's opening it.
const OPEN_ATTEMPTS: usize = 3;
/// What endpoints of this build may begin with.
const TRANSPORTS: &[&str] = &[
    "tcp",
    #[cfg(feature = "zenoh-udp")]
    "udp",
];

/// Returns the session and the endpoints that it listens on.
pub(crate) fn open_session(params: &PublishParams) -> Result<(Session, Vec<String>), PublishError> {
    if !params.zenoh_config.is_empty() {
        let (config, endpoints) = config_from_file(Path::new(&params.zenoh_config))?;
        let session = zenoh::open(config).wait();
        let session = session.map_err(|e| PublishError::Open {
            endpoints: endpoints.join(" "),
            reason: e.to_string(),
        })?;
        return Ok((session, endpoints));
    }
    let mut attempts = 0;
    loop {
        attempts += 1;
        let endpoint = resolve_port(&params.zenoh_listen)?;
        match zenoh::open(config_from_params(params, &endpoint)?).wait() {
            Ok(session) => {
                return Ok((
                    session,
                    Vec::from_iter((!endpoint.is_empty()).then_some(endpoint)),
                ));
            }
            Err(e) if attempts == OPEN_ATTEMPTS || endpoint == params.zenoh_listen => {
                return Err(PublishError::Open {
                    endpoints: endpoint,
                    reason: e.to_string(),
                });
            }
            Err(_) => {}
        }
    }
}

fn config_from_file(path: &Path) -> Result<(Config, Vec<String>), PublishError> {
    let fault = |reason: String| PublishError::Config {
        reason,
        path: path.to_owned(),
    };
    let config = Config::from_file(path).map_err(|e| fault(e.to_string()))?;
    // Endpoints may stand per mode or nested; all texts that look like one are one.
    let listed = config
        .get_json("listen/endpoints")
        .map_err(|e| fault(e.to_string()))?;
    let tree: serde_json::Value =
        serde_json::from_str(&listed).map_err(|e| fault(e.to_string()))?;
    let mut endpoints = Vec::new();
    collect_texts(&tree, &mut endpoints);
    endpoints.retain(|text| text.contains('/'));
    Ok((config, endpoints))
}

fn collect_texts(tree: &serde_json::Value, texts: &mut Vec<String>) {
    match tree {
        serde_json::Value::String(text) => texts.push(text.clone()),
        serde_json::Value::Array(items) => items.iter().for_each(|item| collect_texts(item, texts)),
        serde_json::Value::Object(entries) => entries
            .values()
            .for_each(|entry| collect_texts(entry, texts)),
        _ => {}
    }
}

/// zenoh itself would only log the fault, and try to connect without end.
fn check_transport(name: &'static str, endpoint: &str) -> Result<(), PublishError> {
    match endpoint.split_once('/') {
        Some((transport, _)) if !TRANSPORTS.contains(&transport) => Err(PublishError::Param {
            name,
            found: endpoint.to_owned(),
            expected: "tcp/HOST:PORT, or with --features zenoh-udp udp/HOST:PORT".to_owned(),
        }),
        _ => Ok(()),
    }
}

fn config_from_params(params: &PublishParams, listen: &str) -> Result<Config, PublishError> {
    check_transport("zenoh_listen", listen)?;
    check_transport("zenoh_connect", &params.zenoh_connect)?;
    let mut config = Config::default();
    let list = |endpoint: &str| {
        let endpoints: Vec<&str> = Some(endpoint)
            .filter(|text| !text.is_empty())
            .into_iter()
            .collect();
        serde_json::json!(endpoints).to_string()
    };
    let blocked_micros = MAX_BLOCKED.as_micros().to_string();
    let multicast = params.scouting.to_string();
    let settings = [
        (
            "zenoh_listen",
            &params.zenoh_listen,
            "listen/endpoints",
            list(listen),
        ),
        (
            "zenoh_connect",
            &params.zenoh_connect,
            "connect/endpoints",
            list(&params.zenoh_connect),
        ),
        (
            "scouting",
            &multicast,
            "scouting/multicast/enabled",
            multicast.clone(),
        ),
        // Compiled out today; a build of zenoh that has it would put maps into /dev/shm.
        (
            "zenoh",
            &multicast,
            "transport/shared_memory/enabled",
            "false".to_owned(),
        ),
        (
            "zenoh",
            &blocked_micros,
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            blocked_micros.clone(),
        ),
    ];
    for (name, value, key, json) in settings {
        config
            .insert_json5(key, &json)
            .map_err(|e| PublishError::Param {
                name,
                found: value.clone(),
                expected: format!("an endpoint such as tcp/127.0.0.1:7447, or nothing ({e})"),
            })?;
    }
    Ok(config)
}

/// zenoh's stable interface does not say which port 0 became, so a free one is found first.
fn resolve_port(endpoint: &str) -> Result<String, PublishError> {
    let fault = |e: std::io::Error| PublishError::Open {
        endpoints: endpoint.to_owned(),
        reason: e.to_string(),
    };
    let Some((protocol, address)) = endpoint.split_once('/') else {
        return Ok(endpoint.to_owned());
    };
    let Some(host) = address.strip_suffix(":0") else {
        return Ok(endpoint.to_owned());
    };
    let bound = match protocol {
        "tcp" => std::net::TcpListener::bind((host.trim_matches(['[', ']']), 0))
            .and_then(|l| l.local_addr()),
        "udp" => std::net::UdpSocket::bind((host.trim_matches(['[', ']']), 0))
            .and_then(|s| s.local_addr()),
        _ => return Ok(endpoint.to_owned()),
    };
    Ok(format!(
        "{protocol}/{host}:{}",
        bound.map_err(fault)?.port()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_of_a_transport_that_is_not_built_is_refused_by_name() {
        assert!(check_transport("zenoh_listen", "").is_ok());
        assert!(check_transport("zenoh_listen", "tcp/127.0.0.1:0").is_ok());
        let refused = check_transport("zenoh_connect", "quic/10.0.0.1:7447").unwrap_err();
        let text = refused.to_string();
        assert!(
            text.contains("zenoh_connect") && text.contains("tcp/HOST:PORT"),
            "{text}"
        );
        let is_built = check_transport("zenoh_connect", "udp/10.0.0.1:7447").is_ok();
        assert_eq!(is_built, cfg!(feature = "zenoh-udp"));
    }
}
