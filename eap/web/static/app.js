// Table of all variables: the smallest client of the WebSocket.
const rows = new Map();
const table = document.getElementById("values");
const units = await (await fetch("api/v1/variables")).json();

function row(name) {
  if (!rows.has(name)) {
    const cells = table.insertRow();
    for (let n = 0; n < 4; n++) cells.insertCell();
    cells.cells[0].textContent = name;
    cells.cells[2].textContent = units[name]?.unit ?? "";
    rows.set(name, cells);
  }
  return rows.get(name);
}

function connect() {
  const socket = new WebSocket(new URL("api/v1/ws", location).href.replace(/^http/, "ws"));
  const link = document.getElementById("link");
  socket.onopen = () => socket.send(JSON.stringify({ subscribe: ["values:*/*"] }));
  socket.onclose = () => {
    link.textContent = "disconnected";
    setTimeout(connect, 1000);
  };
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.type === "welcome") {
      document.getElementById("plant").textContent = message.plant;
      link.textContent = "connected";
    }
    for (const [name, [value, age, stale]] of Object.entries(message.values ?? {})) {
      const cells = row(name).cells;
      cells[1].textContent = stale ? "–" : JSON.stringify(value);
      cells[3].textContent = age === null ? "" : `${Math.round(age / 1000)} ms`;
    }
  };
}

connect();
