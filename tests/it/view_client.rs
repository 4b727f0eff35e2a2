//! A viewer that holds what the server says, and checks it: docs/VIEWER.md in a hundred lines.

use std::collections::BTreeMap;
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use splat_view::hash::Hash;
use splat_view::record::{RECORD_WORDS, n_sh_words};

/// Longest wait for a message that must come.
const PATIENCE: Duration = Duration::from_secs(20);

#[derive(Debug, Default, Clone, PartialEq)]
pub struct HeldChunk {
    pub origin: [f32; 3],
    /// Record and harmonics by id.
    pub splats: BTreeMap<u32, Vec<u32>>,
}

pub struct ViewClient {
    pub socket: WebSocket<MaybeTlsStream<TcpStream>>,
    pub welcome: Value,
    /// The last `map` message.
    pub map: Value,
    pub chunks: BTreeMap<u32, HeldChunk>,
    pub keyframes: BTreeMap<u64, Value>,
    /// Bytes of chunks since it connected.
    pub n_bytes: usize,
    /// All other messages, by their type.
    pub events: Vec<Value>,
}

impl HeldChunk {
    fn hash(&self, key: u32) -> Hash {
        let [x, y, z] = self.origin.map(f32::to_bits);
        let splats = self.splats.iter();
        let of_splat =
            |(id, words): (&u32, &Vec<u32>)| Hash::of(&[*id].into_iter().chain(words.clone()));
        Hash::of(&[key, x, y, z].into_iter()) + splats.map(of_splat).sum()
    }
}

impl ViewClient {
    /// `url`: as the server says it.
    pub fn connect(url: &str, held: Option<Self>, more: &Value) -> Self {
        let address = url.replacen("http", "ws", 1) + "ws";
        let (mut socket, _) = tungstenite::connect(address).expect("connects");
        let MaybeTlsStream::Plain(stream) = socket.get_mut() else {
            panic!("encrypted")
        };
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let welcome = text(&socket.read().expect("a welcome"));
        let mut client = Self {
            socket,
            welcome,
            map: Value::Null,
            chunks: BTreeMap::new(),
            keyframes: BTreeMap::new(),
            n_bytes: 0,
            events: Vec::new(),
        };
        let mut hello = json!({"type": "hello", "protocol": 1, "sh_degree": 3});
        if let Some(held) = held {
            let of_chunk = |(key, chunk): (&u32, &HeldChunk)| {
                let [a, b] = chunk.hash(*key).0;
                json!([key, chunk.splats.len(), a, b])
            };
            hello["chunks"] = held.chunks.iter().map(of_chunk).collect();
            hello["map_id"] = held.map["map_id"].clone();
            hello["epoch"] = held.map["epoch"].clone();
            (client.map, client.chunks) = (held.map, held.chunks);
        }
        for (key, value) in more.as_object().into_iter().flatten() {
            hello[key] = value.clone();
        }
        client.say(&hello);
        client
    }

    pub fn say(&mut self, message: &Value) {
        let sent = self.socket.send(Message::text(message.to_string()));
        sent.expect("the server listens");
    }

    pub fn n_splats(&self) -> usize {
        self.chunks.values().map(|chunk| chunk.splats.len()).sum()
    }

    pub fn ids(&self) -> Vec<u32> {
        let mut ids: Vec<u32> = self
            .chunks
            .values()
            .flat_map(|c| c.splats.keys().copied())
            .collect();
        ids.sort_unstable();
        ids
    }

    /// Takes messages in until an update up to `revision` has ended and its hash was right.
    pub fn follow_to(&mut self, revision: u32) {
        loop {
            if self.take() && self.map["revision"].as_u64() >= Some(u64::from(revision)) {
                return;
            }
        }
    }

    /// Takes one message in; `true` for the end of an update.
    pub fn take(&mut self) -> bool {
        let message = self.socket.read().expect("the server goes on");
        if let Message::Binary(bytes) = &message {
            self.n_bytes += bytes.len();
            self.take_chunk(bytes);
            return false;
        }
        let message = text(&message);
        match message["type"].as_str().unwrap() {
            "map" => {
                if message["map_id"] != self.map["map_id"] {
                    self.chunks.clear();
                    self.keyframes.clear();
                }
                self.map = message;
            }
            "keyframes" => {
                for row in message["keyframes"].as_array().unwrap() {
                    assert_eq!(row.as_array().unwrap().len(), 15);
                    self.keyframes.insert(row[0].as_u64().unwrap(), row.clone());
                }
                for id in message["removed"].as_array().unwrap() {
                    assert!(self.keyframes.remove(&id.as_u64().unwrap()).is_some());
                }
            }
            "drop" => {
                for key in message["chunks"].as_array().unwrap() {
                    let key = key.as_u64().unwrap() as u32;
                    assert!(self.chunks.remove(&key).is_some(), "{key} is not held");
                }
            }
            "synced" => {
                assert_eq!(message["revision"], self.map["revision"]);
                let hash: Hash = self.chunks.iter().map(|(key, c)| c.hash(*key)).sum();
                assert_eq!(message["hash"], json!(hash.0), "another map");
                assert_eq!(message["n_splats"], json!(self.n_splats()));
                return true;
            }
            _ => self.events.push(message),
        }
        false
    }

    fn take_chunk(&mut self, bytes: &[u8]) {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!(bytes[0], 1);
        assert!(bytes.len() <= 256 << 10, "{} bytes", bytes.len());
        let (degree, begins, key) = (bytes[1], bytes[2] & 1 == 1, word(4));
        let (n, n_gone) = (word(12) as usize, word(16) as usize);
        let chunk = self.chunks.entry(key).or_default();
        if begins {
            chunk.splats.clear();
        }
        chunk.origin = [20, 24, 28].map(|at| f32::from_bits(word(at)));
        let mut at = 32 + 4 * n;
        let mut splats: Vec<Vec<u32>> = vec![Vec::new(); n];
        for width in [RECORD_WORDS, 2, 4, 4]
            .into_iter()
            .take(1 + usize::from(degree))
        {
            for splat in &mut splats {
                splat.extend((0..width).map(|k| word(at + 4 * k)));
                at += 4 * width;
            }
        }
        assert_eq!(bytes.len(), at + 4 * n_gone);
        for k in 0..n_gone {
            // One that came and went between two updates was never held.
            chunk.splats.remove(&word(at + 4 * k));
        }
        for (k, splat) in splats.into_iter().enumerate() {
            assert_eq!(splat.len(), RECORD_WORDS + n_sh_words(degree));
            chunk.splats.insert(word(32 + 4 * k), splat);
        }
    }
}

fn text(message: &Message) -> Value {
    serde_json::from_str(message.to_text().expect("text")).expect("JSON")
}
