// SPDX-License-Identifier: Apache-2.0
// Questions of a page to the server that it came from.
const PAGE_TOKEN = new URLSearchParams(location.search).get("token");
// Returns the answer, as data, or as a file that the browser saves; throws what the server says against the question.
async function ask(name, question = {}) {
  const headers = { "Content-Type": "application/json", "X-Lathe-Token": PAGE_TOKEN };
  const told = await fetch(`/ask/${name}`, { method: "POST", headers, body: JSON.stringify(question) });
  const file = /filename="(.*)"/.exec(told.headers.get("Content-Disposition"));
  if (file) return save(file[1], await told.blob());
  const found = told.headers.get("Content-Type")?.startsWith("application/json") ? await told.json() : { error: await told.text() };
  if (!told.ok) throw new Error(found.error);
  return found;
}
function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
