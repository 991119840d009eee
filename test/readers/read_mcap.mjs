// Read an MCAP file as the viewers in browsers do: by its index, with every checksum checked.
// Prints one JSON object: profile, topics with counts, and the first waveform and speed decoded.

import { open } from 'node:fs/promises';
import { McapIndexedReader } from '@mcap/core';
import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { decompress } from 'fzstd';

const file = await open(process.argv[2], 'r');
const size = BigInt((await file.stat()).size);
const readable = {
  size: async () => size,
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, Number(length), Number(offset));
    return buffer;
  },
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (buffer) => decompress(buffer) },
});

const decoders = new Map();
const counts = {};
const first = {};
let last = 0n;
let ordered = true;
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  if (!decoders.has(channel.schemaId)) {
    const schema = reader.schemasById.get(channel.schemaId);
    const definitions = parse(new TextDecoder().decode(schema.data), { ros2: true });
    decoders.set(channel.schemaId, new MessageReader(definitions));
  }
  const content = decoders.get(channel.schemaId).readMessage(message.data);
  counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
  ordered = ordered && message.logTime >= last;
  last = message.logTime;
  first[channel.topic] ??= content;
}
const wave = Object.entries(first).find(([, content]) => content.point_step !== undefined);
const view = wave && new DataView(wave[1].data.buffer, wave[1].data.byteOffset);
console.log(JSON.stringify({
  profile: reader.header.profile,
  chunks: reader.chunkIndexes.length,
  statistics: Number(reader.statistics.messageCount),
  counts,
  ordered,
  waveform: wave && {
    topic: wave[0],
    width: wave[1].width,
    fields: wave[1].fields.map((field) => field.name),
    t: [view.getFloat64(0, true), view.getFloat64(wave[1].point_step, true)],
    sample: view.getFloat32(wave[1].fields[1].offset, true),
  },
  speed: first['/speed'] && first['/speed'].twist.linear.x,
}));
