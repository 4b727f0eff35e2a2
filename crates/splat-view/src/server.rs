//! The web server: a thread of its own, with few connections, each bounded in time and bytes.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Path, Request, State};
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, oneshot};
use tokio::time::{Instant, sleep, timeout};
use tokio_rustls::TlsAcceptor;

use crate::access::{Access, COOKIE_NAME};
use crate::hub::Hub;
use crate::settings::{Tls, ViewSettings};
use crate::{page, session, tls};

/// Connections at once, those of pages that load included; more are closed as they come.
const MAX_CONNECTIONS: usize = 128;
/// For a request's head, and for the handshake of TLS.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);
const HEAD_BYTES: usize = 16 << 10;
/// Of a browser: `hello` lists the chunks that it holds.
const MAX_MESSAGE: usize = 1 << 20;
/// Between two lines of the log about connections that are turned away.
const LOG_PERIOD: Duration = Duration::from_secs(60);
/// Nothing from elsewhere, and nothing that takes the page for something else.
const POLICY: &str = "default-src 'self'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self' data: blob:; frame-ancestors 'none'";

/// Runs until it is dropped.
#[derive(Debug)]
pub struct Server {
    url: String,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Clone)]
struct Shared {
    hub: Arc<Hub>,
    access: Access,
    max_clients: usize,
    is_encrypted: bool,
    source: &'static str,
    title: Arc<str>,
}

/// Leaves when a session ends, however it does.
struct Seat(Arc<Hub>);

impl Drop for Seat {
    fn drop(&mut self) {
        self.0.leave();
    }
}

impl Server {
    /// Listens before it returns.
    pub fn start(settings: &ViewSettings, hub: Arc<Hub>) -> io::Result<Self> {
        let listener = listen(settings)?;
        let address = listener.local_addr()?;
        let acceptor = tls::acceptor(&settings.tls, address.ip())?;
        let shared = Shared {
            hub,
            access: Access {
                token: settings.token.clone(),
            },
            max_clients: settings.max_clients,
            is_encrypted: settings.tls != Tls::Off,
            source: settings.source,
            title: settings.title.as_str().into(),
        };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (stop, stopped) = oneshot::channel();
        let serve = move || {
            let serving = accept(listener, acceptor, router(shared));
            runtime.block_on(async {
                tokio::select! {
                    served = serving => if let Err(e) = served {
                        tracing::warn!("the viewer's server has ended: {e}");
                    },
                    _ = stopped => {}
                }
            });
            runtime.shutdown_background();
        };
        let thread = std::thread::Builder::new()
            .name("viewer".to_owned())
            .spawn(serve)?;
        Ok(Self {
            url: url(settings, address),
            stop: Some(stop),
            thread: Some(thread),
        })
    }

    /// For a browser, with the token where there is one.
    pub fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(stop) = self.stop.take() {
            stop.send(()).ok();
        }
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}

fn listen(settings: &ViewSettings) -> io::Result<std::net::TcpListener> {
    let wanted = settings.address;
    let listener = std::net::TcpListener::bind(wanted).or_else(|e| {
        let is_used = e.kind() == io::ErrorKind::AddrInUse && settings.may_take_another_port;
        let fault = || {
            io::Error::new(
                e.kind(),
                format!("the viewer cannot listen on {wanted}: {e}"),
            )
        };
        if is_used {
            std::net::TcpListener::bind((wanted.ip(), 0))
        } else {
            Err(fault())
        }
    })?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

fn url(settings: &ViewSettings, address: SocketAddr) -> String {
    let scheme = if settings.tls == Tls::Off {
        "http"
    } else {
        "https"
    };
    // Of all addresses of the machine, one that its own browser reaches.
    let ip = match address.ip() {
        ip if !ip.is_unspecified() => ip,
        std::net::IpAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
        std::net::IpAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
    };
    let at = SocketAddr::new(ip, address.port());
    let query = settings
        .token
        .as_ref()
        .map(|token| format!("?token={token}"))
        .unwrap_or_default();
    format!("{scheme}://{at}/{query}")
}

async fn accept(
    listener: std::net::TcpListener,
    acceptor: Option<TlsAcceptor>,
    router: Router,
) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let seats = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut logged: Option<Instant> = None;
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            // Too many open files, or a client that was gone at once.
            Err(_) => {
                sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Ok(seat) = Arc::clone(&seats).try_acquire_owned() else {
            if logged.is_none_or(|at| at.elapsed() > LOG_PERIOD) {
                tracing::warn!(
                    "the viewer has {MAX_CONNECTIONS} connections and turns others away"
                );
                logged = Some(Instant::now());
            }
            continue;
        };
        stream.set_nodelay(true).ok();
        let (acceptor, router) = (acceptor.clone(), router.clone());
        tokio::spawn(async move {
            // A client that breaks off or says nonsense is its own fault.
            match acceptor {
                None => serve(TokioIo::new(stream), router).await,
                Some(acceptor) => {
                    if let Ok(Ok(stream)) = timeout(HEAD_TIMEOUT, acceptor.accept(stream)).await {
                        serve(TokioIo::new(stream), router).await;
                    }
                }
            }
            drop(seat);
        });
    }
}

async fn serve<S>(stream: TokioIo<S>, router: Router)
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin + Send + 'static,
{
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(HEAD_BYTES)
        .serve_connection(stream, TowerToHyperService::new(router))
        .with_upgrades()
        .await
        .ok();
}

fn router(shared: Shared) -> Router {
    let check = axum::middleware::from_fn_with_state(shared.clone(), check);
    Router::new()
        .route("/", get(index))
        .route("/viewer.js", get(script))
        .route("/keyframes/{name}", get(keyframe))
        .route("/ws", get(socket))
        .layer(check)
        .with_state(shared)
}

/// Lets a request in or not, and says of every answer what a browser may do with it.
async fn check(
    State(shared): State<Shared>,
    request: Request,
    next: axum::middleware::Next,
) -> Response {
    let headers = request.headers();
    if !shared.access.is_host_fine(headers) {
        let text = "This name is not one of the viewer's: use its address, or localhost.\n";
        return (StatusCode::FORBIDDEN, text).into_response();
    }
    if !shared.access.is_token_fine(headers, request.uri().query()) {
        let text = "The viewer asks for a token: open the address that the mapper printed.\n";
        return (StatusCode::FORBIDDEN, text).into_response();
    }
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

async fn index(State(shared): State<Shared>, request: Request) -> Response {
    let is_named = request
        .uri()
        .query()
        .is_some_and(|query| query.contains("token="));
    let Some(token) = shared.access.token.as_ref().filter(|_| is_named) else {
        return packed(page::PAGE, "text/html; charset=utf-8");
    };
    // The token leaves the address: it would lie in the browser's history, and be seen over a shoulder.
    let secure = if shared.is_encrypted { "; Secure" } else { "" };
    let cookie = format!("{COOKIE_NAME}={token}; HttpOnly; SameSite=Strict; Path=/{secure}");
    let found = (StatusCode::SEE_OTHER, [(header::LOCATION, "/")]);
    let mut response = found.into_response();
    if let Ok(cookie) = HeaderValue::from_str(&cookie) {
        response.headers_mut().insert(header::SET_COOKIE, cookie);
    }
    response
}

async fn script() -> Response {
    packed(page::SCRIPT, "text/javascript; charset=utf-8")
}

fn packed(bytes: &'static [u8], kind: &'static str) -> Response {
    let said: [(HeaderName, &str); 3] = [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_ENCODING, "gzip"),
        (header::CACHE_CONTROL, "no-cache"),
    ];
    (said, Body::from(bytes)).into_response()
}

async fn keyframe(State(shared): State<Shared>, Path(name): Path<String>) -> Response {
    let id = name.strip_suffix(".jpg").and_then(|id| id.parse().ok());
    match id.and_then(|id| shared.hub.thumbnail_of(id)) {
        Some(jpeg) => {
            let said = [
                (header::CONTENT_TYPE, "image/jpeg"),
                (header::CACHE_CONTROL, "no-store"),
            ];
            (said, Body::from(jpeg.to_vec())).into_response()
        }
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn socket(
    State(shared): State<Shared>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    if !Access::is_origin_fine(&headers) {
        return (
            StatusCode::FORBIDDEN,
            "A page of another site may not look in.\n",
        )
            .into_response();
    }
    if !shared.hub.enter(shared.max_clients) {
        let text = format!("{} viewers look already.\n", shared.max_clients);
        return (StatusCode::SERVICE_UNAVAILABLE, text).into_response();
    }
    let seat = Seat(Arc::clone(&shared.hub));
    upgrade
        .max_message_size(MAX_MESSAGE)
        .max_frame_size(MAX_MESSAGE)
        .max_write_buffer_size(2 << 20)
        .on_upgrade(async move |socket| {
            session::serve(socket, Arc::clone(&seat.0), shared.source, &shared.title).await;
            drop(seat);
        })
}
