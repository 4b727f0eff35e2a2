//! One browser's WebSocket: what it asks for, what it receives. It waits for nobody but its own browser.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket};
use serde::Deserialize;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, watch};
use tokio::time::{Instant, timeout};

use crate::hub::{Hub, Latest};
use crate::messages;
use crate::sync::{ClientState, Hello, Plan};
use crate::view_map::ViewMap;

/// For the first message, and for each one that the browser takes.
const HELLO_TIMEOUT: Duration = Duration::from_secs(5);
const SEND_TIMEOUT: Duration = Duration::from_secs(20);
/// A browser that says nothing for so long is gone.
const SILENCE: Duration = Duration::from_secs(60);
/// Between two answers to where the viewer stands: `eye` costs a sort.
const EYE_PERIOD: Duration = Duration::from_millis(400);

/// What a browser says.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Request {
    Hello(Hello),
    Eye { position: [f64; 3] },
    Resync,
    Alive,
}

/// Why a session has ended.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Ended {
    #[error("the browser is gone")]
    Gone,
    #[error("it takes nothing for {} s", SEND_TIMEOUT.as_secs())]
    Slow,
    #[error("{0}")]
    Refused(String),
}

struct Session {
    socket: WebSocket,
    hello: Hello,
    /// `None` before the first map.
    state: Option<ClientState>,
    received: Instant,
    /// When `eye` is looked at again; it waits until then.
    eye_at: Instant,
    eye: Option<[f64; 3]>,
}

/// Serves one browser until it goes, or `source` and `title` are no more.
pub(crate) async fn serve(mut socket: WebSocket, hub: Arc<Hub>, source: &str, title: &str) {
    let ended = match hello(&mut socket, source, title).await {
        Ok(hello) => {
            let now = Instant::now();
            let mut session = Session {
                socket,
                hello,
                state: None,
                received: now,
                eye_at: now,
                eye: None,
            };
            let ended = session.run(&hub).await;
            socket = session.socket;
            ended
        }
        Err(ended) => ended,
    };
    tracing::debug!("a viewer has left: {ended}");
    if let Ended::Refused(reason) = ended {
        let bye = Message::Text(messages::bye(&reason).into());
        timeout(HELLO_TIMEOUT, socket.send(bye)).await.ok();
    }
}

async fn hello(socket: &mut WebSocket, source: &str, title: &str) -> Result<Hello, Ended> {
    let welcome = Message::Text(messages::welcome(source, title).into());
    socket.send(welcome).await.map_err(|_gone| Ended::Gone)?;
    let first = timeout(HELLO_TIMEOUT, socket.recv()).await;
    let late = |_late| Ended::Refused("no hello within 5 s".to_owned());
    let first = first.map_err(late)?;
    let Some(Ok(Message::Text(text))) = first else {
        return Err(Ended::Gone);
    };
    match serde_json::from_str::<Request>(&text) {
        Ok(Request::Hello(hello)) if hello.protocol == messages::PROTOCOL => Ok(hello),
        Ok(Request::Hello(hello)) => Err(Ended::Refused(format!(
            "protocol {}, this server speaks {}: load the page again",
            hello.protocol,
            messages::PROTOCOL
        ))),
        _ => Err(Ended::Refused("the first message is no hello".to_owned())),
    }
}

impl Session {
    async fn run(&mut self, hub: &Hub) -> Ended {
        let (latest, mut events) = hub.watch_events();
        let mut map = hub.watch_map();
        match self.converse(latest, &mut events, &mut map).await {
            Ok(()) => Ended::Refused("the mapper has ended".to_owned()),
            Err(ended) => ended,
        }
    }

    /// Until the hub is gone.
    async fn converse(
        &mut self,
        latest: Latest,
        events: &mut broadcast::Receiver<Arc<str>>,
        map: &mut watch::Receiver<Arc<ViewMap>>,
    ) -> Result<(), Ended> {
        for event in [latest.status, latest.pose, latest.grid, latest.plan]
            .into_iter()
            .flatten()
        {
            self.say(&event).await?;
        }
        loop {
            let newest = Arc::clone(&map.borrow_and_update());
            self.sync(&newest, events).await?;
            let wake = if self.eye.is_some() {
                self.eye_at
            } else {
                self.received + SILENCE
            };
            tokio::select! {
                received = self.socket.recv() => self.receive(received)?,
                event = events.recv() => match event {
                    Ok(event) => self.say(&event).await?,
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => return Ok(()),
                },
                changed = map.changed() => if changed.is_err() { return Ok(()) },
                () = tokio::time::sleep_until(wake) => {}
            }
            if self.received.elapsed() > SILENCE {
                return Err(Ended::Gone);
            }
        }
    }

    /// Sends the browser what it lacks of a map; events and its own messages come in between.
    async fn sync(
        &mut self,
        map: &Arc<ViewMap>,
        events: &mut broadcast::Receiver<Arc<str>>,
    ) -> Result<(), Ended> {
        if map.version == 0 {
            return Ok(());
        }
        let hello = &self.hello;
        let state = self
            .state
            .get_or_insert_with(|| ClientState::new(hello, map));
        if self.eye_at <= Instant::now()
            && let Some(eye) = self.eye.take()
        {
            state.stand_at(eye);
            self.eye_at = Instant::now() + EYE_PERIOD;
        }
        let degree = state.sh_degree();
        let Some(Plan {
            map,
            before,
            chunks,
            after,
        }) = state.plan(map)
        else {
            return Ok(());
        };
        for text in &before {
            self.say(text).await?;
        }
        for (chunk, held) in chunks {
            let update = chunk.update(held, degree, map.epoch);
            for bytes in update.messages() {
                self.send(Message::Binary(bytes.into())).await?;
                while let Ok(event) = events.try_recv() {
                    self.say(&event).await?;
                }
                while let Ok(received) = timeout(Duration::ZERO, self.socket.recv()).await {
                    self.receive(received)?;
                }
            }
        }
        self.say(&after).await
    }

    fn receive(&mut self, received: Option<Result<Message, axum::Error>>) -> Result<(), Ended> {
        self.received = Instant::now();
        let text = match received {
            Some(Ok(Message::Text(text))) => text,
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => return Ok(()),
            Some(Ok(Message::Binary(_))) => {
                return Err(Ended::Refused("bytes, expected text".to_owned()));
            }
            Some(Ok(Message::Close(_)) | Err(_)) | None => return Err(Ended::Gone),
        };
        match serde_json::from_str::<Request>(&text) {
            Ok(Request::Alive) => {}
            Ok(Request::Eye { position }) => self.eye = Some(position),
            Ok(Request::Resync) => {
                if let Some(state) = &mut self.state {
                    state.forget();
                }
            }
            Ok(Request::Hello(_)) => return Err(Ended::Refused("a second hello".to_owned())),
            Err(e) => return Err(Ended::Refused(format!("no message of the protocol: {e}"))),
        }
        Ok(())
    }

    async fn say(&mut self, text: &str) -> Result<(), Ended> {
        self.send(Message::Text(text.into())).await
    }

    async fn send(&mut self, message: Message) -> Result<(), Ended> {
        match timeout(SEND_TIMEOUT, self.socket.send(message)).await {
            Ok(sent) => sent.map_err(|_gone| Ended::Gone),
            Err(_late) => Err(Ended::Slow),
        }
    }
}
