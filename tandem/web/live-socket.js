// A client of the Foxglove WebSocket protocol. It subscribes, and connects again as long as the page is open.

const SUBPROTOCOLS = ["foxglove.sdk.v1"];
const AGAIN_MS = [250, 500, 1000, 2000];

class Socket {
  // wanted(channel): whether to subscribe to it. on: the handlers {info, channel, message, link}.
  constructor(url, wanted, on) {
    this.url = url;
    this.wanted = wanted;
    this.on = on;
    this.failures = 0;
    this.connect();
  }

  connect() {
    this.channels = new Map();
    const socket = new WebSocket(this.url, SUBPROTOCOLS);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({data}) => {
      if (typeof data === "string") this.word(JSON.parse(data), socket);
      else this.data(data);
    };
    socket.onopen = () => { this.failures = 0; };
    socket.onclose = () => {
      this.on.link(false);
      const wait = AGAIN_MS[Math.min(this.failures++, AGAIN_MS.length - 1)];
      setTimeout(() => this.connect(), wait);
    };
  }

  word(word, socket) {
    switch (word.op) {
      case "serverInfo":
        this.on.link(true);
        this.on.info(word);
        break;
      case "advertise": {
        const subscriptions = [];
        for (const {id, topic, schemaName, schema} of word.channels) {
          const channel = {id, topic, schemaName, schema: JSON.parse(schema)};
          if (!this.wanted(channel)) continue;
          // The client chooses the number of a subscription: that of its channel.
          this.channels.set(id, channel);
          this.on.channel(channel);
          subscriptions.push({id, channelId: id});
        }
        if (subscriptions.length) socket.send(JSON.stringify({op: "subscribe", subscriptions}));
        break;
      }
      case "unadvertise":
        for (const id of word.channelIds) this.channels.delete(id);
        break;
      case "status":
        console.warn(word.message);
    }
  }

  data(buffer) {
    const view = new DataView(buffer);
    const channel = this.channels.get(view.getUint32(1, true));
    if (view.getUint8(0) !== 1 || !channel) return;
    const seconds = Number(view.getBigUint64(5, true) / 1000n) / 1e6;
    this.on.message(channel, seconds, JSON.parse(DECODER.decode(new Uint8Array(buffer, 13))));
  }
}

const DECODER = new TextDecoder();
