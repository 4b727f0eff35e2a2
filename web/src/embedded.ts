// Messages that lie in the page itself, as in report.html: base64 of a gzip stream of frames.

const ID = "splat-mapper-embedded";
/// A report holds small maps.
const MAX_BYTES = 256 << 20;

/// Null where the page comes from a server.
export function embedded(): Promise<(string | ArrayBuffer)[]> | null {
  const text = document.getElementById(ID)?.textContent?.trim();
  return text ? unpacked(text) : null;
}

/// Frames: u32 length, u8 kind (0 text, 1 binary), bytes.
async function unpacked(text: string): Promise<(string | ArrayBuffer)[]> {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = await new Response(stream).arrayBuffer();
  if (bytes.byteLength > MAX_BYTES) {
    throw new Error("the embedded map is too large");
  }
  const view = new DataView(bytes);
  const messages: (string | ArrayBuffer)[] = [];
  for (let at = 0; at + 5 <= bytes.byteLength; ) {
    const end = at + 5 + view.getUint32(at, true);
    const isText = view.getUint8(at + 4) === 0;
    if (end > bytes.byteLength) {
      throw new Error("the embedded map is cut off");
    }
    const frame = bytes.slice(at + 5, end);
    messages.push(isText ? new TextDecoder().decode(frame) : frame);
    at = end;
  }
  return messages;
}
