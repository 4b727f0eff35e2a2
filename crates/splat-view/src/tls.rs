//! Encryption: a certificate of the user's, or one made at the start.

use std::fs;
use std::io;
use std::net::IpAddr;
use std::sync::Arc;

use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};

use crate::settings::Tls;

/// `None` where connections are plain.
pub(crate) fn acceptor(tls: &Tls, address: IpAddr) -> io::Result<Option<TlsAcceptor>> {
    let (certificates, key) = match tls {
        Tls::Off => return Ok(None),
        Tls::SelfSigned => self_signed(address)?,
        Tls::Files { certificate, key } => {
            let fault = |what: &str, path: &std::path::Path, reason: String| {
                io::Error::other(format!("{what}: {reason}: {}", path.display()))
            };
            let text = fs::read(certificate)
                .map_err(|e| fault("certificate", certificate, e.to_string()))?;
            let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
            let found = found.map_err(|e| fault("certificate", certificate, e.to_string()))?;
            let text = fs::read(key).map_err(|e| fault("private key", key, e.to_string()))?;
            let of_file = PrivateKeyDer::from_pem_slice(&text);
            (
                found,
                of_file.map_err(|e| fault("private key", key, e.to_string()))?,
            )
        }
    };
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .and_then(|config| {
            config
                .with_no_client_auth()
                .with_single_cert(certificates, key)
        })
        .map_err(|e| io::Error::other(format!("TLS: {e}")))?;
    Ok(Some(TlsAcceptor::from(Arc::new(config))))
}

type Identity = (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>);

fn self_signed(address: IpAddr) -> io::Result<Identity> {
    let names = vec!["localhost".to_owned(), address.to_string()];
    let made = rcgen::generate_simple_self_signed(names).map_err(io::Error::other)?;
    let key =
        PrivateKeyDer::try_from(made.signing_key.serialize_der()).map_err(io::Error::other)?;
    Ok((vec![made.cert.der().clone()], key))
}
