//! Valid and invalid certificates for tests.

use rcgen::{BasicConstraints, CertificateParams, DistinguishedName, DnType, IsCa, Issuer, KeyPair, date_time_ymd};
use std::path::{Path, PathBuf};

const EXPECT: &str = "certificates can be made and written";

/// A certificate authority that issues certificates for tests.
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    pem: String,
}

/// The paths of a certificate and its private key.
pub struct CertificateFiles {
    /// The file of the certificate, in PEM format.
    pub cert: PathBuf,
    /// The file of the private key, in PEM format.
    pub key: PathBuf,
}

impl Authority {
    /// Creates an authority with a new key. Authorities with the same name do not trust each other's certificates.
    ///
    /// # Panics
    /// If the certificate cannot be created.
    pub fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect(EXPECT);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, name);
        let key = KeyPair::generate().expect(EXPECT);
        let pem = params.self_signed(&key).expect(EXPECT).pem();
        Self { issuer: Issuer::new(params, key), pem }
    }

    /// Writes the authority's own certificate to the file `name`, and returns the file's path.
    ///
    /// # Panics
    /// If the file cannot be written.
    pub fn file(&self, directory: &Path, name: &str) -> PathBuf {
        let path = directory.join(name);
        std::fs::write(&path, &self.pem).expect(EXPECT);
        path
    }

    /// Issues a certificate for these names, valid from the start of 2020 to the start of `until_year`. Writes it and
    /// its key to `file.pem` and `file.key`, and replaces existing files.
    ///
    /// # Panics
    /// If the certificate cannot be created or a file cannot be written.
    pub fn issue(&self, directory: &Path, file: &str, names: &[&str], until_year: i32) -> CertificateFiles {
        let mut params =
            CertificateParams::new(names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>()).expect(EXPECT);
        (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(until_year, 1, 1));
        let own = KeyPair::generate().expect(EXPECT);
        let pair = CertificateFiles {
            cert: directory.join(format!("{file}.pem")),
            key: directory.join(format!("{file}.key")),
        };
        std::fs::write(&pair.cert, params.signed_by(&own, &self.issuer).expect(EXPECT).pem()).expect(EXPECT);
        std::fs::write(&pair.key, own.serialize_pem()).expect(EXPECT);
        pair
    }
}
