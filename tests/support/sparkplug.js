// Decodes payloads of Sparkplug B with sparkplug-payload: lines "TOPIC HEX" in, JSON lines out.
// With arguments it encodes one payload, given as JSON, to hexadecimal digits.
const { decodePayload, encodePayload } = require("sparkplug-payload").get("spBv1.0");
const plain = (_, value) => (value !== null && typeof value === "object" && "unsigned" in value ? Number(value) : value);
if (process.argv.length > 2) {
  console.log(Buffer.from(encodePayload(JSON.parse(process.argv[2]))).toString("hex"));
} else {
  require("readline").createInterface({ input: process.stdin }).on("line", (line) => {
    const [topic, digits] = line.split(" ");
    const payload = decodePayload(Buffer.from(digits, "hex"));
    console.log(JSON.stringify({ topic, payload }, plain));
  });
}
