//! A client's TLS connections, and the reasons why a connection is not trusted.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use tokio_rustls::rustls::crypto::{CryptoProvider, ring, verify_tls13_signature};
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use tokio_rustls::rustls::version::TLS13;
use tokio_rustls::rustls::{
    AlertDescription, CertificateError, ClientConfig, DigitallySignedStruct, Error, InvalidMessage, RootCertStore,
    SignatureScheme,
};
use tonic::codegen::{Service, http::Uri};

use crate::credentials::{CA, CERT, Credentials, KEY, Trust};

/// Maximal time to wait for a server to show that it speaks TLS.
const PROBE_TIMEOUT: Duration = Duration::from_secs(1);
/// The first bytes that an HTTP/2 client sends.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// The first byte of a TLS alert.
const ALERT: u8 = 0x15;

/// Opens TLS connections to one server.
#[derive(Clone)]
pub(crate) struct Connector {
    host: String,
    port: u16,
    name: ServerName<'static>,
    config: Arc<ClientConfig>,
    shows_certificate: bool,
    failure: TlsFailure,
}

/// The reason why client or server did not trust the other side of the last connection. `None` if there was no problem
/// of trust.
type TlsFailure = Arc<Mutex<Option<String>>>;

impl Connector {
    /// Creates a connector to the server at this host and port. The server's certificate must be valid for `name`.
    ///
    /// # Errors
    /// The reason why the credentials cannot be used.
    pub(crate) fn new(host: &str, port: u16, name: &str, credentials: Credentials) -> Result<Self, String> {
        let provider = Arc::new(ring::default_provider());
        let words = |error: &dyn ToString| error.to_string();
        let verifier: Arc<dyn ServerCertVerifier> = match credentials.trust {
            Trust::Pinned(pinned) => Arc::new(PinnedVerifier { pinned, provider: Arc::clone(&provider) }),
            Trust::Authorities(authorities) => {
                let mut roots = RootCertStore::empty();
                roots.add_parsable_certificates(authorities);
                let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider));
                verifier.build().map_err(|error| format!("{CA}: {error}"))?
            }
        };
        let shows_certificate = credentials.identity.is_some();
        let builder = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])
            .map_err(|error| words(&error))?
            .dangerous() // required for setting a verifier
            .with_custom_certificate_verifier(verifier);
        let mut config = match credentials.identity {
            Some((chain, key)) => builder
                .with_client_auth_cert(chain, key)
                .map_err(|error| format!("{CERT} and {KEY} do not match: {error}"))?,
            None => builder.with_no_client_auth(),
        };
        config.alpn_protocols = vec![b"h2".to_vec()];
        let name = ServerName::try_from(name.to_owned())
            .map_err(|_| format!("`{name}` cannot be the name of a certificate"))?;
        let host = host.to_owned();
        let failure = Arc::default();
        Ok(Self { host, port, name, config: Arc::new(config), shows_certificate, failure })
    }

    /// Returns why one side of the last connection, client or server, did not trust the other side's certificate.
    /// `None` if there was no such problem.
    pub(crate) fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Service<Uri> for Connector {
    type Response = TokioIo<AlertRecordingStream>;
    type Error = io::Error;
    type Future = Pin<Box<dyn Future<Output = io::Result<Self::Response>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        let Self { host, port, name, config, shows_certificate, failure } = self.clone();
        Box::pin(async move {
            let tcp = TcpStream::connect((host.as_str(), port)).await?;
            tcp.set_nodelay(true)?;
            let stream = TlsConnector::from(config).connect(name, tcp).await;
            let reason = stream.as_ref().err().and_then(|error| describe_failure(error, &host));
            *failure.lock().unwrap_or_else(PoisonError::into_inner) = reason;
            stream.map(|stream| TokioIo::new(AlertRecordingStream { stream, shows_certificate, failure })).map_err(
                |error| match error.kind() {
                    io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => io::Error::other(
                        "it ended the connection in TLS's handshake; if the server does not use TLS, write \
                         tcp:// instead of https://",
                    ),
                    _ => error,
                },
            )
        })
    }
}

/// Describes why the server is not trusted. Returns `None` for errors of the transport, such as corrupted bytes, after
/// which another attempt may succeed.
fn describe_failure(error: &io::Error, host: &str) -> Option<String> {
    use CertificateError as Bad;
    let error = error.get_ref()?.downcast_ref::<Error>()?;
    Some(match error {
        Error::InvalidCertificate(Bad::Expired | Bad::ExpiredContext { .. }) => {
            "its certificate has expired; whoever runs it must renew it".into()
        }
        Error::InvalidCertificate(Bad::NotValidYet | Bad::NotValidYetContext { .. }) => {
            "its certificate is not valid yet: are the clocks right?".into()
        }
        Error::InvalidCertificate(Bad::UnknownIssuer | Bad::BadSignature) => {
            format!("no trusted authority has signed its certificate; set {CA} to the authority's certificate")
        }
        Error::InvalidCertificate(Bad::NotValidForName | Bad::NotValidForNameContext { .. }) => {
            format!("its certificate is not for this name: {error}")
        }
        Error::InvalidCertificate(Bad::ApplicationVerificationFailure) => {
            "its certificate is not the expected one".into()
        }
        Error::InvalidCertificate(other) => format!("its certificate is not good: {other}"),
        Error::InvalidMessage(InvalidMessage::InvalidContentType) => {
            format!(
                "the server does not use TLS; write tcp:// instead of https://, or check which program listens at \
                 {host}"
            )
        }
        Error::AlertReceived(
            AlertDescription::ProtocolVersion
            | AlertDescription::HandshakeFailure
            | AlertDescription::NoApplicationProtocol,
        ) => format!("it does not speak TLS 1.3 for HTTP/2: {error}"),
        _ => return None,
    })
}

/// A TLS stream that records the alert by which a server rejects the client's certificate. In TLS 1.3 this alert
/// arrives only after the handshake.
pub(crate) struct AlertRecordingStream {
    stream: TlsStream<TcpStream>,
    shows_certificate: bool,
    failure: TlsFailure,
}

impl AlertRecordingStream {
    fn record_alert(&self, error: &io::Error) {
        use AlertDescription as Alert;
        let Some(Error::AlertReceived(
            alert @ (Alert::CertificateRequired
            | Alert::BadCertificate
            | Alert::UnsupportedCertificate
            | Alert::CertificateRevoked
            | Alert::CertificateExpired
            | Alert::CertificateUnknown
            | Alert::UnknownCA
            | Alert::AccessDenied
            | Alert::DecryptError), // the certificate's signature is not its issuer's
        )) = error.get_ref().and_then(|error| error.downcast_ref())
        else {
            return;
        };
        let reason = match self.shows_certificate {
            true if *alert == Alert::CertificateExpired => {
                format!("the certificate of {CERT} has expired; have it renewed by its authority")
            }
            true => format!("it accepts no client with the certificate of {CERT}: another authority must sign it"),
            false => format!("it asks for a client's certificate; set {CERT} and {KEY} to your files"),
        };
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason);
    }
}

impl AsyncRead for AlertRecordingStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        if let Poll::Ready(Err(error)) = &polled {
            self.record_alert(error);
        }
        polled
    }
}

impl AsyncWrite for AlertRecordingStream {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

/// Whether the server at this address speaks TLS. Such a server answers an unencrypted request with a TLS alert.
pub(crate) async fn speaks_tls(host: &str, port: u16) -> bool {
    let ask = async {
        let mut tcp = TcpStream::connect((host, port)).await?;
        tcp.write_all(PREFACE).await?;
        tcp.read_u8().await
    };
    matches!(timeout(PROBE_TIMEOUT, ask).await, Ok(Ok(ALERT)))
}

/// A verifier that trusts exactly one server certificate. It checks neither the name nor the dates in it.
#[derive(Debug)]
struct PinnedVerifier {
    /// Only the first certificate is trusted.
    pinned: Vec<CertificateDer<'static>>,
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for PinnedVerifier {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        if self.pinned.first().is_some_and(|pinned| pinned == certificate) {
            return Ok(ServerCertVerified::assertion());
        }
        Err(Error::InvalidCertificate(CertificateError::ApplicationVerificationFailure))
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Error::General("only TLS 1.3 is spoken here".into()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &self.provider.signature_verification_algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}
