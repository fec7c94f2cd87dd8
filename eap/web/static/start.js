// Load the page again when one of its files did not come: its server may just have been restarted.

addEventListener("error", ({ target }) => {
  if (target instanceof HTMLElement) setTimeout(() => location.reload(), 3000);
}, true);
