//! The map itself in the report: the viewer's page with everything in it, begun when a reader asks for it.

use std::io::Write;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use maud::{Markup, PreEscaped, html};
use sha2::{Digest, Sha256};

use splat_view::page;

/// Unpacks the viewer's script and begins it; nothing of it runs before the button is pressed.
const LOADER: &str = r#"document.getElementById("walk").addEventListener("click", async (event) => {
  event.target.remove();
  document.getElementById("splat-mapper-viewer").hidden = false;
  const packed = Uint8Array.from(atob(document.getElementById("splat-mapper-script").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.type = "module";
  script.src = URL.createObjectURL(new Blob([await new Response(stream).text()], { type: "text/javascript" }));
  document.head.append(script);
});"#;

/// What a browser may do with the page: nothing from elsewhere, no script but the viewer's where it is there.
pub(crate) fn policy(has_viewer: bool) -> String {
    let still = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'";
    if !has_viewer {
        return still.to_owned();
    }
    let hash = STANDARD.encode(Sha256::digest(LOADER));
    format!(
        "{still}; script-src 'sha256-{hash}' 'wasm-unsafe-eval' blob:; worker-src blob:; connect-src data: blob:"
    )
}

/// `frames`: messages of the viewer, as `splat_view::embedded` makes them.
pub(crate) fn section(frames: &[u8]) -> std::io::Result<Markup> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(frames)?;
    let data = STANDARD.encode(gzip.finish()?);
    let script = STANDARD.encode(page::SCRIPT);
    Ok(html! {
        section.card {
            h2 { "The map" }
            button #walk type="button" { "Walk in the map" }
            div #splat-mapper-viewer hidden style="position: relative; height: min(75vh, 800px)" {}
            script #splat-mapper-embedded type="application/octet-stream" { (PreEscaped(data)) }
            script #splat-mapper-script type="application/octet-stream" { (PreEscaped(script)) }
            script { (PreEscaped(LOADER)) }
        }
    })
}
