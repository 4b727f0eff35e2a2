//! The viewer's server and strangers: wrong tokens, origins, hosts, paths and frames, slow heads, thousands of connections.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use crate::view_client::ViewClient;
use crate::viewer::{holds, publish, settings, snapshot, started, watched};
use splat_ros::transport::{Event, Transport};
use splat_types::image::RgbImage;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;
use splat_view::settings::ViewSettings;
use splat_view::transport::ViewTransport;

/// The answer to a request as it stands.
fn answer(viewer: &ViewTransport, request: &str) -> String {
    let address = viewer.url().trim_start_matches("http://");
    let address = address.split('/').next().unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(20)))
        .unwrap();
    let request = request.replace("HOST", address);
    stream.write_all(request.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).ok();
    String::from_utf8_lossy(&bytes).into_owned()
}

fn get(viewer: &ViewTransport, path: &str, more: &str) -> String {
    answer(
        viewer,
        &format!("GET {path} HTTP/1.1\r\nHost: HOST\r\nConnection: close\r\n{more}\r\n"),
    )
}

fn socket(viewer: &ViewTransport, path: &str, more: &str) -> String {
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
    answer(
        viewer,
        &format!("GET {path} HTTP/1.1\r\nHost: HOST\r\n{upgrade}{more}\r\n"),
    )
}

#[test]
fn the_page_and_thumbnails_are_served_and_nothing_else() {
    let viewer = started();
    let newest = Arc::new(snapshot(100, 2, 1));
    let image = Arc::new(RgbImage {
        width_px: 800,
        height_px: 600,
        pixels: vec![90; 3 * 800 * 600],
    });
    let (id, stamp) = (newest.poses[0].keyframe_id, newest.poses[0].stamp);
    viewer.observe(&Event::Keyframe {
        stamp,
        image: &image,
    });
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    let page = get(&viewer, "/", "");
    assert!(page.starts_with("HTTP/1.1 200"), "{page}");
    assert!(page.contains("content-encoding: gzip") && page.contains("content-security-policy"));
    assert!(get(&viewer, "/viewer.js", "").starts_with("HTTP/1.1 200"));
    let thumbnail = get(&viewer, &format!("/keyframes/{id}.jpg"), "");
    assert!(thumbnail.contains("image/jpeg") && thumbnail.contains("JFIF"));
    for path in [
        "/keyframes/77.jpg",
        "/keyframes/../../Cargo.toml",
        "/keyframes/%2e%2e%2fCargo.toml",
        "/../Cargo.toml",
        "/etc/passwd",
        "/keyframes/99999999999999999999.jpg",
        "/keyframes/.jpg",
    ] {
        let found = get(&viewer, path, "");
        assert!(found.starts_with("HTTP/1.1 404"), "{path}: {found}");
    }
}

#[test]
fn strangers_are_refused() {
    let viewer = ViewTransport::start(&ViewSettings {
        token: Some("0123456789abcdef".to_owned()),
        ..settings()
    })
    .unwrap();
    for path in [
        "/",
        "/viewer.js",
        "/ws",
        "/?token=",
        "/?token=0123456789abcdee",
        "/keyframes/0.jpg",
    ] {
        assert!(get(&viewer, path, "").starts_with("HTTP/1.1 403"), "{path}");
    }
    let found = get(&viewer, "/?token=0123456789abcdef", "");
    assert!(found.starts_with("HTTP/1.1 303"), "{found}");
    assert!(found.contains("HttpOnly; SameSite=Strict") && found.contains("location: /\r\n"));
    let cookie = "Cookie: splat_mapper_token=0123456789abcdef\r\n";
    assert!(get(&viewer, "/", cookie).starts_with("HTTP/1.1 200"));
    assert!(socket(&viewer, "/ws", "").starts_with("HTTP/1.1 403"));
    let stranger = format!("{cookie}Origin: http://evil.example\r\n");
    assert!(socket(&viewer, "/ws", &stranger).starts_with("HTTP/1.1 403"));
    assert_eq!(viewer.hub().n_clients(), 0);
    // Without a token a name that is none of the machine's own is a page's of somebody else.
    let open = started();
    let rebound = answer(
        &open,
        "GET / HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n",
    );
    assert!(rebound.starts_with("HTTP/1.1 403"), "{rebound}");
}

#[test]
fn nonsense_ends_its_own_connection_alone() {
    let (viewer, newest, mut client) = watched(1000, 4);
    for wrong in [
        json!("hello"),
        json!({"type": "hello", "protocol": 2}),
        json!({"type": "eye", "position": [1, 2, 3]}),
        json!({"type": "hello", "protocol": 1, "chunks": [[1, 2]]}),
        json!({"type": "hello", "protocol": 1, "max_splats": -1}),
    ] {
        let address = viewer.url().replacen("http", "ws", 1) + "ws";
        let (mut socket, _) = tungstenite::connect(address).unwrap();
        socket.read().unwrap();
        socket
            .send(tungstenite::Message::text(wrong.to_string()))
            .unwrap();
        let bye = socket.read().unwrap();
        assert!(bye.to_text().unwrap().contains("bye"), "{wrong}: {bye}");
    }
    let mut other = ViewClient::connect(viewer.url(), None, &json!({}));
    other.follow_to(1);
    other.say(&json!({"type": "eye", "position": [1e300, 0, 0]}));
    other.say(&json!({"type": "alive"}));
    let huge = tungstenite::Message::text("x".repeat(3 << 20));
    other.socket.send(huge).ok();
    while other.socket.read().is_ok() {}
    // A frame of the WebSocket that is none, and a head that never ends.
    let address = viewer
        .url()
        .trim_start_matches("http://")
        .trim_end_matches('/')
        .to_owned();
    let mut slow = TcpStream::connect(&address).unwrap();
    slow.write_all(b"GET / HTTP/1.1\r\nHost: 127").unwrap();
    let long = "a".repeat(40_000);
    let refused = get(&viewer, "/", &format!("X-Long: {long}\r\n"));
    assert!(!refused.starts_with("HTTP/1.1 200"), "{refused}");
    slow.set_read_timeout(Some(Duration::from_secs(20)))
        .unwrap();
    let mut rest = Vec::new();
    slow.read_to_end(&mut rest).ok();
    assert!(
        !String::from_utf8_lossy(&rest).contains("200"),
        "it was answered"
    );
    let next = Arc::new(Snapshot {
        revision: 2,
        ..(*newest).clone()
    });
    publish(&viewer, &next);
    client.follow_to(2);
    holds(&client, &next);
}

#[test]
fn ten_thousand_connections_leave_those_that_were_there() {
    let (viewer, newest, mut client) = watched(1000, 4);
    let address = viewer
        .url()
        .trim_start_matches("http://")
        .trim_end_matches('/')
        .to_owned();
    let mut open = Vec::new();
    for n in 0..10_000 {
        // Who says nothing for a minute is taken for gone.
        if n % 1000 == 0 {
            client.say(&json!({"type": "alive"}));
        }
        let Ok(mut stream) = TcpStream::connect(&address) else {
            continue;
        };
        if n % 50 == 0 {
            stream.write_all(b"GET /ws HTTP/1.1\r\n").ok();
            open.push(stream);
        }
    }
    let next = Arc::new(Snapshot {
        revision: 2,
        ..(*newest).clone()
    });
    publish(&viewer, &next);
    client.follow_to(2);
    drop(open);
    // Seats are free again once the heads are given up.
    let patience = Stopwatch::start();
    while !get(&viewer, "/", "").starts_with("HTTP/1.1 200") {
        assert!(patience.secs() < 20.0, "nobody gets in");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn no_more_clients_than_asked_for() {
    let viewer = ViewTransport::start(&ViewSettings {
        max_clients: 2,
        ..settings()
    })
    .unwrap();
    publish(&viewer, &Arc::new(snapshot(100, 2, 1)));
    let mut clients: Vec<ViewClient> = (0..2)
        .map(|_| ViewClient::connect(viewer.url(), None, &json!({})))
        .collect();
    clients.iter_mut().for_each(|client| client.follow_to(1));
    let refused = socket(&viewer, "/ws", "");
    assert!(refused.starts_with("HTTP/1.1 503"), "{refused}");
}
