// The socket: comes back by itself, gives texts and frames on, acknowledges a frame once it is drawn.

const VIEWS = ["3d", "axial", "coronal", "sagittal", "ultrasound", "x-ray"];
const MAGIC = 0x33464c4d; // "MLF3"
const HEADER = 40 + 8 * VIEWS.length;

export class Link {
  constructor({ onText, onFrame, onOpen, onClose }) {
    Object.assign(this, { onText, onFrame, onOpen, onClose });
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.onOpen();
    socket.onmessage = async ({ data }) => {
      if (typeof data === "string") return this.onText(JSON.parse(data));
      const frame = readFrame(data);
      if (!frame) return;
      try {
        await this.onFrame(frame);
      } finally {
        this.send({ type: "ack", frame: frame.number });
      }
    };
    socket.onclose = () => { this.onClose(); setTimeout(() => this.connect(), 700); };
    this.socket = socket;
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }
}

// The layout is in the server's protocol.rs.
function readFrame(buffer) {
  const d = new DataView(buffer);
  if (buffer.byteLength < HEADER || d.getUint32(0, true) !== MAGIC) return null;
  const frame = {
    number: d.getUint32(4, true), time: d.getFloat64(8, true), epoch: d.getFloat64(16, true),
    viewSequence: d.getFloat64(24, true), renderMs: d.getFloat32(32, true), views: {},
  };
  let at = HEADER;
  VIEWS.forEach((name, v) => {
    const bytes = d.getUint32(44 + 8 * v, true);
    if (bytes > 0) {
      const jpeg = new Blob([new Uint8Array(buffer, at, bytes)], { type: "image/jpeg" });
      frame.views[name] = { width: d.getUint16(40 + 8 * v, true), height: d.getUint16(42 + 8 * v, true), jpeg };
    }
    at += bytes;
  });
  return frame;
}
