for (const input of document.querySelectorAll(".pair input")) {
  const cut = () => input.parentElement.style.setProperty("--cut", input.value + "%");
  input.addEventListener("input", cut);
  input.addEventListener("pointermove", (e) => {
    const box = input.getBoundingClientRect();
    input.value = (100 * (e.clientX - box.left)) / box.width;
    cut();
  });
}
