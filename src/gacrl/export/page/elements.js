// Elements of the page, made and found without a line of HTML: texts stay texts.

export function byId(id) {
  return document.getElementById(id);
}

// make("button", {class: "key", onclick: f}, "text", element, …)
export function make(tag, settings = {}, ...inside) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(settings)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null) element.setAttribute(name, String(value));
  }
  element.append(...inside);
  return element;
}

// Sets a text only where it changes, so that screen readers hear what is new.
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
