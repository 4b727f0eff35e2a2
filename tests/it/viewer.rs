//! The viewer's server: clients hold what was published, whatever they do, and nobody is held up by them.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use crate::deltas::next;
use crate::formats::{Dice, random_snapshot};
use crate::view_client::ViewClient;
use splat_ros::transport::{Event, Transport};
use splat_types::image::RgbImage;
use splat_types::snapshot::Snapshot;
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::time::Stopwatch;
use splat_types::transform::Similarity;
use splat_view::record;
use splat_view::settings::{Tls, ViewSettings};
use splat_view::transport::ViewTransport;

fn settings() -> ViewSettings {
    ViewSettings {
        address: "127.0.0.1:0".parse().unwrap(),
        may_take_another_port: false,
        token: None,
        tls: Tls::Off,
        max_clients: 8,
        sh_degree: 1,
        source: "live",
        title: "test".to_owned(),
    }
}

fn started() -> ViewTransport {
    ViewTransport::start(&settings()).unwrap()
}

fn publish(viewer: &ViewTransport, snapshot: &Arc<Snapshot>) {
    viewer.observe(&Event::Map {
        snapshot,
        map_from_world: Similarity::IDENTITY,
    });
}

/// Splats hang on the keyframes in turn.
fn spread(mut snapshot: Snapshot) -> Snapshot {
    let mut splats = (*snapshot.splats).clone();
    let keyframes = snapshot.poses.iter().map(|pose| pose.keyframe_id);
    let keyframes: Vec<u32> = keyframes.collect();
    let of = |id: &u32| keyframes[*id as usize % keyframes.len()];
    splats.anchors = snapshot.splat_ids.iter().map(of).collect();
    snapshot.splats = Arc::new(splats);
    snapshot
}

fn snapshot(n: usize, n_keyframes: usize, seed: u32) -> Snapshot {
    spread(random_snapshot(n, n_keyframes, 1, seed))
}

fn holds(client: &ViewClient, snapshot: &Snapshot) {
    assert_eq!(client.map["revision"], json!(snapshot.revision));
    assert_eq!(client.ids(), *snapshot.splat_ids);
}

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
fn after_a_thousand_revisions_and_a_break_clients_hold_the_published_map() {
    let viewer = started();
    let mut dice = Dice(3);
    let mut newest = Arc::new(snapshot(30_000, 12, 1));
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    holds(&client, &newest);
    assert_eq!(client.keyframes.len(), 12);
    assert_eq!(client.welcome["source"], json!("live"));
    for revision in 2..=1000 {
        newest = Arc::new(spread(next(&newest, &mut dice)));
        publish(&viewer, &newest);
        if revision % 10 == 0 {
            client.follow_to(revision);
            holds(&client, &newest);
        }
    }
    // Away for a while, and back: what is the same is not sent again.
    let whole = client
        .chunks
        .values()
        .map(|c| c.splats.len() * 28)
        .sum::<usize>();
    let mut changed = (*newest.splats).clone();
    changed.means[0][0] += 1.0;
    newest = Arc::new(Snapshot {
        revision: 1001,
        splats: Arc::new(changed),
        ..(*newest).clone()
    });
    client.socket.close(None).ok();
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), Some(client), &json!({}));
    client.follow_to(1001);
    holds(&client, &newest);
    assert!(
        client.n_bytes < whole / 3,
        "{} of {whole} bytes",
        client.n_bytes
    );
    assert!(client.n_bytes > 0);
    // A late joiner gets it all, and little more than it has.
    let mut late = ViewClient::connect(viewer.url(), None, &json!({}));
    late.follow_to(1001);
    assert_eq!(late.chunks, client.chunks);
    assert!(
        late.n_bytes as f64 <= 1.2 * whole as f64,
        "{} of {whole}",
        late.n_bytes
    );
}

#[test]
fn corrections_resets_and_another_map_begin_anew() {
    let viewer = started();
    let mut newest = Arc::new(snapshot(2000, 6, 1));
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    // A loop: keyframes and splats move.
    let mut moved = (*newest).clone();
    (moved.epoch, moved.revision) = (moved.epoch + 1, 2);
    moved.poses[5].world_from_cam.translation.x += 1.0;
    let mut splats = (*moved.splats).clone();
    splats.means.iter_mut().for_each(|mean| mean[0] += 1.0);
    moved.splats = Arc::new(splats);
    newest = Arc::new(moved);
    publish(&viewer, &newest);
    client.follow_to(2);
    holds(&client, &newest);
    assert_eq!(client.map["epoch"], json!(newest.epoch));
    let x = client.keyframes[&u64::from(newest.poses[5].keyframe_id)][6].as_f64();
    assert_eq!(x, Some(newest.poses[5].world_from_cam.translation.x));
    // Another map, smaller, by a client that was away.
    let mut other = snapshot(500, 2, 9);
    (other.map_id, other.revision) = ([9; 16], 3);
    client.socket.close(None).ok();
    publish(&viewer, &Arc::new(other.clone()));
    let mut client = ViewClient::connect(viewer.url(), Some(client), &json!({}));
    client.follow_to(3);
    holds(&client, &other);
    assert_eq!(client.keyframes.len(), 2);
    // Who says that it holds nothing gets everything.
    client.chunks.clear();
    client.say(&json!({"type": "resync"}));
    client.follow_to(3);
    holds(&client, &other);
}

#[test]
fn a_small_device_gets_what_is_near() {
    let viewer = started();
    let all = Arc::new(snapshot(40_000, 10, 1));
    publish(&viewer, &all);
    let mut client = ViewClient::connect(
        viewer.url(),
        None,
        &json!({"max_splats": 15_000, "sh_degree": 0}),
    );
    client.follow_to(1);
    assert!(
        (1..=15_000).contains(&client.n_splats()),
        "{}",
        client.n_splats()
    );
    assert_eq!(client.map["sh_degree"], json!(0));
    let far = *viewer
        .hub()
        .newest()
        .chunks
        .iter()
        .find(|(key, _)| !client.chunks.contains_key(key))
        .unwrap()
        .0;
    let place = viewer.hub().newest().chunks[&far].origin;
    client.say(&json!({"type": "eye", "position": place}));
    while !client.chunks.contains_key(&far) {
        while !client.take() {}
    }
    assert!(client.n_splats() <= 15_000);
}

#[test]
fn who_never_reads_holds_nobody_up() {
    let viewer = started();
    let mut dice = Dice(5);
    let mut newest = Arc::new(snapshot(20_000, 8, 1));
    publish(&viewer, &newest);
    let deaf: Vec<ViewClient> = (0..3)
        .map(|_| ViewClient::connect(viewer.url(), None, &json!({})))
        .collect();
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    for revision in 2..=60 {
        newest = Arc::new(spread(next(&newest, &mut dice)));
        publish(&viewer, &newest);
        client.follow_to(revision);
    }
    holds(&client, &newest);
    assert_eq!(viewer.hub().n_clients(), 4);
    drop(deaf);
}

#[test]
fn nothing_is_made_while_nobody_looks() {
    let viewer = started();
    publish(&viewer, &Arc::new(snapshot(100, 2, 1)));
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(viewer.hub().newest().version, 0);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    assert_eq!(viewer.hub().newest().version, 1);
    client.socket.close(None).ok();
    while client.socket.read().is_ok() {}
    let patience = Stopwatch::start();
    while viewer.hub().n_clients() > 0 {
        assert!(patience.secs() < 10.0, "it stays");
        std::thread::sleep(Duration::from_millis(5));
    }
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
    let viewer = started();
    let newest = Arc::new(snapshot(1000, 4, 1));
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
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
    let viewer = started();
    let newest = Arc::new(snapshot(1000, 4, 1));
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    let address = viewer
        .url()
        .trim_start_matches("http://")
        .trim_end_matches('/')
        .to_owned();
    let mut open = Vec::new();
    for n in 0..10_000 {
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

#[test]
fn records_hold_splats_within_their_steps() {
    let splats = random_snapshot(500, 2, 3, 4).splats;
    let origin = [0.5, -0.25, 1.0];
    for ix in 0..splats.len() {
        let [w0, w1, w2, w3] = record::record(&splats, ix, origin);
        let byte = |word: u32, k: u32| (word >> (8 * k)) as u8;
        for c in 0..3 {
            let value = 0.5 + SH_C0 * splats.sh[ix * splats.sh_stride() + c as usize];
            let found = f32::from(byte(w0, c)) / 255.0 * 2.0 - 0.5;
            assert!(
                (found - value.clamp(-0.5, 1.5)).abs() < 0.005,
                "{found} {value}"
            );
        }
        let opacity = 1.0 / (1.0 + (-splats.opacity_logits[ix]).exp());
        assert!((f32::from(byte(w0, 3)) / 255.0 - opacity).abs() < 0.003);
        for (k, bits) in [w1 as u16, (w1 >> 16) as u16, w2 as u16]
            .into_iter()
            .enumerate()
        {
            let found = half::f16::from_bits(bits).to_f32() + origin[k];
            let wanted = splats.means[ix][k];
            let step = 1e-3 * (wanted - origin[k]).abs() + 1e-6;
            assert!((found - wanted).abs() < step, "{found} {wanted}");
        }
        for k in 0..3 {
            let found = (f32::from(byte(w3, k)) - 1.0) * 21.0 / 254.0 - 12.0;
            let wanted = splats.log_scales[ix][k as usize].clamp(-12.0, 9.0);
            assert!((found - wanted).abs() < 0.042, "{found} {wanted}");
        }
        assert!(angle_between(&splats, ix, w2, w3) < 0.035, "splat {ix}");
    }
}

/// Between a splat's rotation and that of its record, rad.
fn angle_between(splats: &Splats, ix: usize, w2: u32, w3: u32) -> f32 {
    let at = |k: u32| ((w2 >> k) & 255) as f32 / 255.0 * 2.0 - 1.0;
    let (u, v) = (at(16), at(24));
    let z = 1.0 - u.abs() - v.abs();
    let fold = (-z).max(0.0);
    let axis = glam::Vec3::new(u - fold * u.signum(), v - fold * v.signum(), z).normalize_or_zero();
    let angle = (w3 >> 24) as f32 / 255.0 * std::f32::consts::PI;
    let found = glam::Quat::from_axis_angle(axis, angle);
    let [w, x, y, z] = splats.quats[ix];
    let wanted = glam::Quat::from_xyzw(x, y, z, w).normalize();
    2.0 * found.dot(wanted).abs().min(1.0).acos()
}
